"""The unit of a map that bundle adjustment may not change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend.mapper import Mapper
from prism_edge.backend.unit import keep_unit
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import scaled
from tests.backend.world import Teller
from tests.tracking.cloud import pose_at

POSES = [pose_at(0.2 * i, 0.03 * (i % 3), 0.02 * i, 0.0, -0.03 * i) for i in range(6)]


def grown(noise_px: float = 0.0) -> Mapper:
    teller, mapper = Teller(250, noise_px=noise_px), Mapper(replace(BackendConfig(), observations=300))
    for pose in POSES:
        mapper.absorb(teller.keyframe(pose))
    return mapper


@pytest.mark.parametrize("held", [0, 4])
@pytest.mark.parametrize("shrunk", [0.5, 1.0, 1.7])
def test_a_solution_of_another_size_gets_the_size_that_was(shrunk, held):
    world = grown().world
    centre = world.keyframes[held].world_from_camera[:3, 3]
    poses, points = {}, {}
    for k in set(range(len(POSES))) - {held}:
        pose = world.keyframes[k].world_from_camera
        poses[k] = scaled(pose, shrunk).copy()
        poses[k][:3, 3] = centre + shrunk * (pose[:3, 3] - centre)
    for p, point in world.points.items():
        points[p] = centre + shrunk * (point.position - centre)
    assert keep_unit(world, held, poses, points) == pytest.approx(1 / shrunk)
    for k, pose in poses.items():
        assert pose == pytest.approx(world.keyframes[k].world_from_camera)
    for p, position in points.items():
        assert position == pytest.approx(world.points[p].position)


def test_a_few_points_that_moved_do_not_make_a_unit():
    world = grown().world
    points = {p: point.position.copy() for p, point in world.points.items()}
    for p in list(points)[:50]:
        points[p] *= 3.0
    assert keep_unit(world, 0, {}, points) == pytest.approx(1.0)


def test_points_that_only_two_see_count_where_there_are_no_others():
    """They have followed the two; a few that a third sees tell more than all of them."""
    world = grown().world
    firm = {p for p, point in world.points.items() if len(point.keyframes) >= 3}
    for p in sorted(firm)[10:]:
        world.points[p].keyframes = set(sorted(world.points[p].keyframes)[:2])
    firm = set(sorted(firm)[:10])
    points = {p: (1.0 if p in firm else 2.0) * point.position for p, point in world.points.items()}
    assert len(points) > 5 * len(firm)
    assert keep_unit(world, 0, {}, dict(points)) == pytest.approx(1.0)
    others = {p: place for p, place in points.items() if p not in firm}
    assert keep_unit(world, 0, {}, others) == pytest.approx(0.5)


def test_nothing_to_go_by_changes_nothing():
    world = grown().world
    assert keep_unit(world, 0, {}, {}) == 1.0
    centre = world.keyframes[4].world_from_camera[:3, 3]
    points = {p: centre.copy() for p in list(world.points)[:20]}  # how far away is one that is nowhere?
    assert keep_unit(world, 4, {}, points) == 1.0
    assert all(np.array_equal(place, centre) for place in points.values())


def test_a_map_without_metric_depth_stays_as_big_as_it_was():
    mapper = grown(noise_px=0.5)
    before = {p: point.position.copy() for p, point in mapper.world.points.items()}
    for _ in range(30):
        assert mapper.optimise(5, 0.0) is not None
    ids = [p for p in before if p in mapper.world.points]
    ratio = [np.linalg.norm(mapper.world.points[p].position) / np.linalg.norm(before[p]) for p in ids]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)
