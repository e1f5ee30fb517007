"""The widest angle between a point's rays, against angles that are known."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.window import choose_window, solve, widest_parallax
from tests.backend.test_window import CONFIG, world_of
from tests.backend.world import chain
from tests.tracking.cloud import pose_at


def test_it_is_that_to_the_ray_farthest_from_the_first_and_no_other_two():
    """Of three views a right angle apart in turn the first and the second see the point under 90 degrees."""
    world = chain([pose_at(*centre) for centre in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, -0.8, 0.0))])
    for k in world.keyframes:
        world.observe(k, 0, 0)
    assert widest_parallax(world, {0: np.zeros(3)}) == pytest.approx({0: 90.0})
    among = widest_parallax(world, {0: np.zeros(3)}, {1, 2})
    assert among == pytest.approx({0: np.degrees(np.arccos(-0.8))})
    assert widest_parallax(world, {0: np.zeros(3)}, {2}) == pytest.approx({0: 0.0}, abs=1e-5)


def test_a_point_between_two_cameras_is_seen_from_opposite_sides():
    """Whatever rounding makes of it: a cosine beyond -1 has no angle."""
    rng = np.random.default_rng(0)
    for _ in range(8):
        one, other = rng.normal(size=(2, 3))
        world = chain([pose_at(*one), pose_at(*other)])
        shared = {p: one + t * (other - one) for p, t in zip(range(100, 110), rng.random(10), strict=True)}
        angles = np.array(list(widest_parallax(world, shared).values()))
        assert angles == pytest.approx(np.full(10, 180.0), abs=1e-4)


def test_widest_parallax_is_from_the_first_ray_to_the_farthest():
    world, teller = world_of()
    ids = sorted(world.points)[:50]
    angles = widest_parallax(world, {p: world.points[p].position for p in ids})
    for p in ids:
        rays = [
            teller.cloud.positions[p] - world.keyframes[k].world_from_camera[:3, 3]
            for k in sorted(world.points[p].keyframes)
        ]
        rays = [ray / np.linalg.norm(ray) for ray in rays]
        expected = max(np.degrees(np.arccos(min(1.0, rays[0] @ ray))) for ray in rays)
        assert angles[p] == pytest.approx(expected, abs=1e-4)


def test_how_wide_apart_rays_are_is_said_of_where_the_window_has_put_its_keyframes():
    """A camera that turns on the spot, its newest keyframe tracked a step aside: nothing is triangulated."""
    world, _ = world_of([pose_at(0.0, 0.0, 0.0, 0.0, 0.15 * i) for i in range(3)], 0.0)
    newest = world.keyframes[2]
    newest.world_from_camera = newest.world_from_camera @ pose_at(0.06)
    solution = solve(world, choose_window(world, 2, CONFIG), CONFIG, 1.0, use_depth=True)
    assert solution is not None
    assert np.linalg.norm(solution.poses[2][:3, 3]) < 0.01
    assert np.quantile(list(solution.parallax_deg.values()), 0.9) < 0.2
