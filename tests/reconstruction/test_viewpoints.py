"""Keyframes of a map in metres, against a map that was worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap, GlobalPoint
from prism_edge.backend.map_export import metric_map
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import from_rt, so3_exp
from prism_edge.reconstruction.viewpoints import Viewpoint, viewpoints

CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, "pinhole", (-0.1, 0.0, 0.0, 0.0))
MOUNT = np.array([[0, 0, 1, 0.2], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1.0]])
METRES = 2.5  # per map unit
TURN = so3_exp(np.array([0.0, 0.1, 0.0]))
PLACES = {1: (0.0, 0.1, 4.0), 2: (0.3, 0.0, 6.0), 3: (-0.2, -0.2, 5.0), 4: (0.1, 0.1, 3.0), 9: (50.0, 0, 4.0)}
FIRM = {1, 2, 4, 9}


def world() -> GlobalMap:
    """Three keyframes beside each other, one without a stamp, and one apart."""
    made = GlobalMap()
    poses = {
        0: (np.eye(3), (0.0, 0.0, 0.0), 900),
        1: (TURN, (0.5, 0.0, 0.0), 300),
        2: (np.eye(3), (1.0, 0.0, 0.0), None),
        3: (np.eye(3), (0.0, 0.0, -1.0), 600),
        8: (np.eye(3), (50.0, 0.0, 0.0), 700),
    }
    seen = {0: (1, 2, 3), 1: (1, 2, 3, 4), 2: (2, 4), 3: (1,), 8: (9,)}
    for number, (rotation, place, taken_ns) in poses.items():
        pose = from_rt(rotation, np.array(place))
        local = np.array([(np.array(PLACES[p]) - pose[:3, 3]) @ rotation for p in seen[number]])
        pixels = local[:, :2] / local[:, 2:] * 500.0 + (320.0, 240.0)
        count = len(local)
        made.keyframes[number] = GlobalKeyframe(
            number, number, CAMERA, pose, pixels, np.ones(count), {}, taken_ns=taken_ns
        )
    for point, place in PLACES.items():
        made.points[point] = GlobalPoint(np.array(place), parallax_deg=2.0 if point in FIRM else 0.5)
    for number, points in seen.items():
        for keypoint, point in enumerate(points):
            made.observe(number, point, keypoint)
    return made


def seen_in(world: GlobalMap, metres: float = 1.0) -> list[Viewpoint]:
    return viewpoints(world, metric_map(world, float(np.log(metres)), MOUNT))


@pytest.fixture(scope="module")
def made() -> list[Viewpoint]:
    return seen_in(world(), METRES)


def test_those_with_a_stamp_and_a_place_by_their_stamps(made: list[Viewpoint]) -> None:
    assert [(view.keyframe, view.stamp_ns) for view in made] == [(1, 300), (3, 600), (0, 900)]


def test_poses_are_in_metres_in_map(made: list[Viewpoint]) -> None:
    expected = MOUNT @ from_rt(TURN, np.array([0.5 * METRES, 0.0, 0.0]))
    np.testing.assert_allclose(made[0].map_from_camera, expected, atol=1e-12)


def test_triangulated_points_are_where_the_camera_took_them(made: list[Viewpoint]) -> None:
    """Raw pixels and depth in metres of 1 and 2; 3 is only seeded."""
    view = made[2]
    np.testing.assert_allclose(view.depths, [4.0 * METRES, 6.0 * METRES])
    rays = CAMERA.normalise(view.pixels)
    np.testing.assert_allclose(rays, [(0.0, 0.025), (0.05, 0.0)], atol=1e-9)
    assert len(made[0].depths) == 3


def test_those_that_share_most_come_first(made: list[Viewpoint]) -> None:
    assert made[2].beside == (1, 2, 3), "1 shares three points, 2 and 3 share one each"
    assert made[0].beside == (0, 2, 3)
    assert made[1].beside == (0, 1)


def test_a_point_behind_its_camera_is_left_out() -> None:
    turned = world()
    turned.points[1].position = np.array([0.0, 0.0, -2.0])
    view = seen_in(turned)[2]
    np.testing.assert_allclose(view.depths, [6.0])
    assert len(view.pixels) == 1


def test_a_map_without_stamps_has_none() -> None:
    bare = world()
    for keyframe in bare.keyframes.values():
        keyframe.taken_ns = None
    assert seen_in(bare) == []
