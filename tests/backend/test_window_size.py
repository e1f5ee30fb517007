"""Whose size a window's keyframes have: that of held poses, a network's, or a sensor's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend import window as module
from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.ties import untied
from prism_edge.backend.window import Window, solve
from prism_edge.geometry.poses import scaled
from tests.backend.test_window import CONFIG, grown, world_of
from tests.backend.world import depth_at_keypoints
from tests.tracking.cloud import pose_at


def turned_away(factor: float, depth_factor: float = 1.0) -> tuple[GlobalMap, Window]:
    """Four keyframes that drive off after eight on the spot, on new ground ``factor`` times too large."""
    spot = [pose_at(0.0, 0.0, 0.0, 0.0, 0.02 * i) for i in range(8)]
    drive = [pose_at(0.1 * i, 0.02 * i, 0.05 * i) for i in range(1, 5)]
    world, teller = world_of(spot + drive)
    depth_at_keypoints(world, teller.cloud, teller.poses, depth_factor)
    for keyframe in world.keyframes.values():
        keyframe.world_from_camera = scaled(keyframe.world_from_camera, factor)
        keyframe.depth_units = 1.0
    for point in world.points.values():
        point.position, point.parallax_deg = factor * point.position, 0.5
    points = sorted(p for p, point in world.points.items() if len(point.keyframes) >= 2)
    return world, Window([8, 9, 10, 11], list(range(8)), points)


def driven(solution) -> float:
    """How far the camera drove, over how far it did."""
    return float(np.linalg.norm(solution.poses[11][:3, 3]) / np.linalg.norm([0.4, 0.08, 0.2]))


@pytest.mark.parametrize("factor", [0.6, 1.5])
def test_after_a_turn_on_the_spot_the_network_says_how_large_the_new_ground_is(factor):
    """Eight poses are held, and place nothing among them: all lengths could be others."""
    often = replace(CONFIG, iterations=100)
    world, window = turned_away(factor)
    assert untied(world, window.held, window.free, window.points) == window.free
    assert driven(solve(world, window, often, 1.0, use_depth=False)) == pytest.approx(factor, rel=0.01)
    assert driven(solve(world, window, often, 1.0, use_depth=True)) == pytest.approx(1.0, abs=0.03)
    # In a map whose unit is half a metre all is twice as large.
    assert driven(solve(world, window, often, 2.0, use_depth=True)) == pytest.approx(2.0, abs=0.06)


def test_what_says_how_far_each_point_is_has_no_vote_on_sizes(monkeypatch):
    """It would count twice."""
    world, window = turned_away(1.0)
    asked = []
    monkeypatch.setattr(module, "sizes", lambda world, keyframes, *_: asked.append(keyframes) or [])
    for sigma in (0.0, 0.01):
        for keyframe in world.keyframes.values():
            keyframe.depth_sigma = sigma
        module.assemble(world, window, CONFIG, 1.0, use_depth=True)
    assert asked == [window.free, []]
    # Nor has a network whose every depth is a factor, which it is while one pose is held.
    young = Window(window.held[1:] + window.free, [0], window.points)
    module.assemble(world, young, CONFIG, 1.0, use_depth=True)
    assert len(asked) == 2


def test_a_network_says_nothing_of_the_size_of_what_held_poses_place():
    world, _ = grown(1.0, depth_factor=1.5)
    for keyframe in world.keyframes.values():
        keyframe.depth_units = 1.0
    points = sorted(p for p, point in world.points.items() if len(point.keyframes) >= 2)
    window = Window([3, 4, 5], [0, 1, 2], points)
    assert untied(world, window.held, window.free, window.points) == []
    alone, told = (solve(world, window, CONFIG, 1.0, use_depth) for use_depth in (False, True))
    for k in window.free:
        np.testing.assert_allclose(told.poses[k], alone.poses[k], atol=1e-6)
