"""The tracker's map made from the backend's."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.local_copy import SEEDED_SIGMA, local_copy
from prism_edge.tracking.mapping import MATCHING_SIGMA_PX
from prism_edge.tracking.recovery import locate
from prism_edge.tracking.view import View
from tests.backend.world import Teller
from tests.tracking.cloud import CAMERA, Cloud, check, pose_at


def told(count: int = 6) -> tuple[GlobalMap, Teller]:
    teller, world = Teller(), GlobalMap()
    for i in range(count):
        world.absorb(teller.keyframe(pose_at(0.1 * i)))
    return world, teller


def test_its_bookkeeping_is_sound_and_says_what_the_backends_says() -> None:
    world, _ = told(25)
    world.points[min(world.points)].parallax_deg = 2.0
    for point in world.points.values():
        point.made_by = max(point.keyframes)  # triangulated from the newer view
    unseen = max(world.points)
    world.points[unseen].made_by = -1  # as in a map from a file
    copy = local_copy(world)
    check(copy)
    assert list(copy.keyframes) == sorted(world.keyframes)
    for number, keyframe in copy.keyframes.items():
        source = world.keyframes[number]
        seen = {int(keyframe.points[i]): i for i in keyframe.observed().tolist()}
        assert seen == source.observed
        np.testing.assert_array_equal(keyframe.world_from_camera, source.world_from_camera)
        assert keyframe.neighbours == [k for k, n in world.covisible(number)[:20] if n >= 15]
    table = copy.points
    assert table.ids.tolist() == sorted(world.points)
    for row, number in enumerate(table.ids.tolist()):
        np.testing.assert_array_equal(table.position[row], world.points[number].position)
        assert table.parallax_deg[row] == pytest.approx(world.points[number].parallax_deg)
        viewers = world.points[number].keyframes
        assert table.reference[row] == (min(viewers) if number == unseen else max(viewers))
    assert table.log_depth_sigma[0] < SEEDED_SIGMA == table.log_depth_sigma[1]


def test_it_knows_how_the_camera_moved_in_the_unit_of_now() -> None:
    world, _ = told(2)
    world.keyframes[1].twist, world.keyframes[1].grown = np.array([0.3, 0.0, -0.1, 0.0, 0.5, 0.2]), 2.0
    copy = local_copy(world)
    assert copy.keyframes[1].twist.tolist() == [0.6, 0.0, -0.2, 0.0, 0.5, 0.2]
    assert not copy.keyframes[0].twist.any()


def test_a_point_that_its_maker_no_longer_sees_goes_by_the_oldest_that_does() -> None:
    world, _ = told()
    point = next(p for p, seen in world.points.items() if len(seen.keyframes) >= 4)
    *viewers, maker = sorted(world.points[point].keyframes)
    world.points[point].made_by = maker
    world.drop_observation(maker, point)
    table = local_copy(world).points
    assert table.reference[table.ids.tolist().index(point)] == viewers[0]


def test_nothing_of_it_is_news_and_new_points_get_new_numbers() -> None:
    world, _ = told(3)
    copy = local_copy(world)
    assert copy.changes.new_points == []
    assert copy.heard == 2, "its corrections knew all of it"
    assert [k.stamp_ns for k in copy.keyframes.values()] == [0, 0, 0]
    keyframe = copy.newest()
    free = np.array([0])
    keyframe.points[free] = -1
    ids = copy.add_points(keyframe, free, np.zeros((1, 3)), np.ones(1), 1.0)
    assert ids[0] == max(world.points) + 1
    assert ids[0] not in world.points


def test_points_look_as_the_newest_keyframe_saw_them() -> None:
    world, _ = told()
    copy = local_copy(world)
    newest = copy.newest()
    rows = copy.points.rows(newest.points[newest.observed()])
    descriptors = newest.features.descriptors[newest.observed()]
    np.testing.assert_array_equal(copy.points.descriptor[rows], descriptors)


def test_a_camera_is_found_in_it() -> None:
    world, teller = told()
    copy = local_copy(world)
    cloud: Cloud = teller.cloud
    true = pose_at(0.25, 0.05)
    features, _ = cloud.view(true, 0.5)
    found = locate(copy, View(CAMERA, features), copy.newest(), 0)
    assert found is not None
    np.testing.assert_allclose(found[:3, 3], true[:3, 3], atol=0.03)


def test_a_map_without_points_is_copied_as_it_is() -> None:
    world, _ = told(1)
    world.points.clear()
    world.keyframes[0].observed.clear()
    copy = local_copy(world)
    assert len(copy.points) == 0
    assert list(copy.keyframes) == [0]


def test_the_wider_the_parallax_the_surer_the_depth() -> None:
    """A pixel's sigma is the angle 1 / f, in radians as the parallax."""
    world, _ = told()
    first = min(world.points)
    world.points[first].parallax_deg = 2.0
    sigma = local_copy(world).points.log_depth_sigma[0]
    assert sigma == pytest.approx(MATCHING_SIGMA_PX / (CAMERA.fx * 0.0349), rel=1e-3)


def test_what_the_tracker_moves_does_not_move_in_the_backend() -> None:
    world, _ = told(2)
    before = world.keyframes[1].world_from_camera.copy()
    local_copy(world).keyframes[1].world_from_camera[:3, 3] += 1.0
    np.testing.assert_array_equal(world.keyframes[1].world_from_camera, before)
