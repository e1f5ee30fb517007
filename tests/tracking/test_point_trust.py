"""Points that have stood for longer outweigh those that have only just come."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.poses import inverse, se3_log
from prism_edge.tracking.frame_tracking import FrameTracker, TrackedFrame
from prism_edge.tracking.point_trust import LEAST_WEIGHT, trust
from prism_edge.tracking.view import View
from tests.tracking.cloud import CAMERA, FACTORS, Cloud, pose_at

TRUE = pose_at(0.25, 0.05)
SECOND = 1_000_000_000


def world_with_a_mover(share: float, seed: int = 0):
    """A map of which ``share`` of the points lies on something that has since moved by 5 cm to the side.

    The mover's points are new; the others were there a long time ago.
    """
    cloud = Cloud(500, seed=seed)
    world, _ = cloud.mapped([np.eye(4), pose_at(0.2)], noise_px=0.3)
    table = world.points
    world.newest().stamp_ns = 10 * SECOND
    moving = np.random.default_rng(seed).random(len(table)) < share
    table.born_ns[:] = np.where(moving, 10 * SECOND - SECOND // 5, SECOND)
    table.position[moving] += (-0.05, 0.0, 0.0)  # it is seen 5 cm farther along than the map has it
    return cloud, world, moving


def placed(cloud, world, proven_after_s: float) -> float:
    """Error (m) of a frame tracked in such a map."""
    features, _ = cloud.view(TRUE, noise_px=0.3, bits=10)
    tracker = FrameTracker(FACTORS, 5000, proven_after_s)
    tracker.refresh_local_map(world, world.newest().points)
    k = world.newest()
    before = TrackedFrame(
        CAMERA, k.features, k.world_from_camera, k.points.copy(), np.zeros((6, 6)), len(k.points)
    )
    frame = tracker.track(world, View(CAMERA, features), pose_at(0.24, 0.05), before, 25)
    return float(np.linalg.norm(se3_log(inverse(TRUE) @ frame.world_from_camera)[:3]))


@pytest.mark.parametrize("seed", [0, 1])
def test_a_mover_that_fills_more_than_half_of_the_image_does_not_take_the_camera_along(seed):
    cloud, world, _ = world_with_a_mover(0.6, seed)
    assert placed(cloud, world, 0.0) > 0.015, "by majority, the mover is the world"
    cloud, world, _ = world_with_a_mover(0.6, seed)
    assert placed(cloud, world, 1.5) < 0.005


def test_where_all_is_new_nothing_changes():
    errors = []
    for proven_after_s in (0.0, 1.5):
        cloud, world, _ = world_with_a_mover(0.0)
        world.points.born_ns[:] = 10 * SECOND - 100
        errors.append(placed(cloud, world, proven_after_s))
    assert errors[1] == pytest.approx(errors[0], abs=2e-3)


def test_the_weight_grows_with_the_square_of_age_and_the_gate_s_say_ends_with_it():
    _, world, _ = world_with_a_mover(0.0)
    table = world.points
    table.born_ns[:6] = np.array([10.0, 9.5, 9.0, 9.0, 9.0, 0.0]) * SECOND
    table.weight[:6] = (1.0, 1.0, 1.0, 0.4, 0.0, 0.0)
    found = trust(table, np.arange(6), 10 * SECOND, 2.0)
    np.testing.assert_allclose(found, [LEAST_WEIGHT, 0.0625, 0.25, 0.25 * 0.7, 0.25 * 0.5, 1.0])
    ageless = trust(table, np.arange(6), 10 * SECOND, 0.0)
    np.testing.assert_allclose(ageless, [1, 1, 1, 0.4, LEAST_WEIGHT, LEAST_WEIGHT])
    np.testing.assert_allclose(trust(table, np.arange(1), 0, 2.0), LEAST_WEIGHT)  # a clock that went back


def test_the_backends_weights_reach_the_points_that_are_still_there():
    _, world, _ = world_with_a_mover(0.0)
    ids = np.array([3, 10**6, 5])
    world.weigh(ids, np.array([0.2, 0.3, 0.7], np.float32))
    rows = world.points.rows(ids[[0, 2]])
    np.testing.assert_allclose(world.points.weight[rows], [0.2, 0.7], rtol=1e-6)
    world.weigh(ids, np.zeros(0, np.float32))
    np.testing.assert_allclose(world.points.weight[rows], [0.2, 0.7], rtol=1e-6)


def test_what_a_camera_that_stands_has_watched_for_long_has_stood():
    world, _ = Cloud(200, seed=0).mapped([np.eye(4)])
    rows, frames = np.arange(len(world.points)), FrameTracker(FACTORS, 5000, proven_after_s=1.5)
    for taken_ns, stood in ((0, False), (2 * SECOND, False), (3 * SECOND, True), (0, False)):
        assert np.all(frames.proven(world, rows, taken_ns) == stood), taken_ns
    world.newest().stamp_ns = 3 * SECOND  # of a frame from before the newest keyframe
    assert frames.proven(world, rows, 0).all()
