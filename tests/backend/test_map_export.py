"""A map in metres against one that was worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap, GlobalPoint
from prism_edge.backend.map_export import MetricMap, metric_map
from prism_edge.geometry.poses import from_rt, so3_exp
from tests.tracking.cloud import CAMERA

# The camera looks ahead (its z is the base's x, its x the base's -y) from 0.2 m before, 0.5 m above the base.
MOUNT = np.array([[0, 0, 1, 0.2], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1.0]])
METRES = 2.5  # per map unit
TURN = so3_exp(np.array([0.0, np.pi / 2, 0.0]))  # about the camera's y, which is down: to its right


def keyframe(
    number: int, rotation: np.ndarray, place: tuple[float, ...], taken_ns: int | None
) -> GlobalKeyframe:
    pose = from_rt(rotation, np.array(place, np.float64))
    none, one = np.zeros((3, 2)), np.ones(3)
    return GlobalKeyframe(number, 9 * number, CAMERA, pose, none, one, {}, taken_ns=taken_ns)


def by_hand() -> GlobalMap:
    """Two units ahead, then a turn to the right; a point; beside it a part whose place nobody knows."""
    world = GlobalMap()
    world.keyframes = {
        5: keyframe(5, TURN, (0.0, 0.0, 2.0), 700),  # not in their order
        2: keyframe(2, np.eye(3), (0.0, 0.0, 0.0), 300),
        3: keyframe(3, np.eye(3), (0.0, 0.0, 2.0), None),
        8: keyframe(8, np.eye(3), (50.0, 0.0, 0.0), 900),
    }
    for point, place, seen in (
        (1, (1.0, 2.0, 4.0), (2, 3, 5)),
        (4, (0.0, 0.0, 6.0), (3, 2)),
        (6, (50.0, 0.0, 1.0), (8,)),
    ):
        world.points[point] = GlobalPoint(np.array(place))
        for number in seen:
            world.observe(number, point, point % 3)
    return world


@pytest.fixture(scope="module")
def made() -> MetricMap:
    return metric_map(by_hand(), np.log(METRES), MOUNT)


def test_the_first_camera_is_where_it_sat_on_the_robot(made: MetricMap) -> None:
    np.testing.assert_allclose(made.map_from_camera[0], MOUNT, atol=1e-12)
    np.testing.assert_allclose(made.map_from_base[0], np.eye(4), atol=1e-12)


def test_the_way_is_in_metres_and_the_mount_as_long_as_it_was(made: MetricMap) -> None:
    """Two units of 2.5 m ahead are 5 m along x; the camera then is 0.2 m before and 0.5 m above that."""
    np.testing.assert_allclose(made.map_from_camera[1][:3, 3], (5.2, 0.0, 0.5), atol=1e-12)
    np.testing.assert_allclose(made.map_from_base[1], from_rt(np.eye(3), np.array([5.0, 0, 0])), atol=1e-12)
    np.testing.assert_allclose(made.extent, (5.0, 0.0, 0.0), atol=1e-12)


def test_a_turn_of_the_camera_swings_the_base_about_it(made: MetricMap) -> None:
    """Looking to the right, the base is 0.2 m behind it: to the left, along y, and looks along -y."""
    np.testing.assert_allclose(made.map_from_camera[2][:3, 3], (5.2, 0.0, 0.5), atol=1e-12)
    expected = np.array([[0, 1, 0, 5.2], [-1, 0, 0, 0.2], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    np.testing.assert_allclose(made.map_from_base[2], expected, atol=1e-12)


def test_points_are_where_the_camera_saw_them(made: MetricMap) -> None:
    """(1, 2, 4) units right, down and ahead: 2.5, 5 and 10 m from the camera."""
    np.testing.assert_allclose(made.points, [(10.2, -2.5, -4.5), (15.2, 0.0, 0.5)], atol=1e-12)


def test_a_part_without_a_place_is_left_out_and_counted(made: MetricMap) -> None:
    assert (len(made.map_from_camera), made.elsewhere) == (3, 1)
    assert np.abs(made.points).max() < 20.0
    joined = by_hand()
    joined.observe(8, 1, 0)
    assert len(metric_map(joined, 0.0, MOUNT).points) == 3


def test_keyframes_without_a_stamp_are_not_in_the_trajectory(made: MetricMap) -> None:
    assert made.stamps == (300, None, 700)
    for of_base, poses in ((False, made.map_from_camera), (True, made.map_from_base)):
        rows = made.trajectory(of_base)
        assert [stamp for stamp, _ in rows] == [300, 700]
        np.testing.assert_array_equal([pose for _, pose in rows], poses[[0, 2]])


def test_a_map_of_one_keyframe_and_no_points() -> None:
    world = GlobalMap()
    world.keyframes[0] = keyframe(0, np.eye(3), (0.0, 0.0, 0.0), 0)
    made = metric_map(world, 0.0, MOUNT)
    assert made.points.shape == (0, 3)
    assert made.trajectory(True)[0][0] == 0, "a stamp of 0 is one"
    np.testing.assert_array_equal(made.extent, np.zeros(3))
