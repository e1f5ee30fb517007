"""Poses by map points of which some are doubtful."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.map_correction import refit
from prism_edge.tracking.motion import Prediction
from prism_edge.tracking.point_trust import LEAST_WEIGHT
from prism_edge.tracking.pose_from_map import (
    ENOUGH_TRIANGULATED,
    SHARED_SEED_ERROR,
    PoseFromMap,
    depth_error,
    reference_origins,
    shared_depth_error,
)
from prism_edge.tracking.view import View
from tests.tracking.cloud import CAMERA, FACTORS, Cloud, pose_at


def test_depth_errors_lie_along_the_first_rays():
    cloud = Cloud(100, seed=4)
    world, _ = cloud.mapped([pose_at(0.5, 0.1)], sigma=0.2)
    rows = np.arange(len(world.points))
    origins = reference_origins(world, rows)
    assert origins == pytest.approx(np.tile([0.5, 0.1, 0.0], (len(rows), 1)))
    error = depth_error(world.points, rows, origins)
    assert error == pytest.approx(0.2 * (world.points.position - [0.5, 0.1, 0.0]))


def test_beside_firm_points_a_seed_s_depth_counts_five_times_less():
    """Those of one network share their error; among few firm points they are all there is to go by."""
    world, _ = Cloud(300, seed=4).mapped([pose_at()], sigma=0.01)
    table, rows = world.points, np.arange(len(world.points))
    seeds = rows % 2 == 0
    table.log_depth_sigma[seeds] = 0.2
    own = depth_error(table, rows, reference_origins(world, rows))
    assert (~seeds).sum() >= ENOUGH_TRIANGULATED
    error = shared_depth_error(world, rows)
    assert error[seeds] == pytest.approx(SHARED_SEED_ERROR * own[seeds])
    assert np.array_equal(error[~seeds], own[~seeds])
    few = np.r_[rows[seeds], rows[~seeds][: ENOUGH_TRIANGULATED - 1]]
    assert np.array_equal(shared_depth_error(world, few, world.centres()), own[few])


def test_points_that_were_just_made_count_less_than_those_that_have_stood():
    """A third of what is seen has moved by 3 cm, and is new."""
    cloud = Cloud(500, seed=2)
    world, _ = cloud.mapped([pose_at(), pose_at(0.3)])
    table, there = world.points, pose_at(0.1)
    new = table.reference == 1
    table.born_ns[:] = np.where(new, world.newest().stamp_ns, world.newest().stamp_ns - 10**11)
    table.position[new] += (0.03, 0.0, 0.0)
    view = world.keyframes[1]
    keypoints = view.observed()
    rows = table.rows(view.points[keypoints])
    assert 0.02 < new[rows].mean() < 0.5
    young = new[rows]
    off = []
    for proven_after_s in (0.0, 1.0):
        pose = PoseFromMap(FACTORS, proven_after_s)
        found = pose.estimate(world, View(CAMERA, view.features), there, rows, keypoints)
        off.append(np.linalg.norm((found.world_from_camera - pose_at(0.3))[:3, 3]))
        assert found.inliers[~young].all()
    assert off[1] < 0.5 * off[0]


def test_points_grow_old_before_a_camera_that_stands_and_makes_no_keyframe():
    """They were made with the newest keyframe, and have been seen in place for as long as it is old."""
    cloud = Cloud(300, seed=4)
    world, _ = cloud.mapped([pose_at()], sigma=0.0)
    view, table = world.keyframes[0], world.points
    keypoints = view.observed()
    rows = table.rows(view.points[keypoints])
    pose, told = PoseFromMap(FACTORS, proven_after_s=1.0), []
    for taken_s in (0.0, 1.0, 1.5, 2.0, 60.0):
        taken = View(CAMERA, view.features, round(1e9 * taken_s))
        found = pose.estimate(world, taken, pose_at(), rows, keypoints)
        told.append(np.trace(found.information))
    expected = np.array([LEAST_WEIGHT, LEAST_WEIGHT, 0.25, 1.0, 1.0])
    assert told == pytest.approx(told[-1] * expected)


def test_a_frame_that_is_placed_anew_counts_its_points_as_old_as_when_it_was_tracked():
    """Against what was expected of it, by which a few young points are outweighed."""
    cloud = Cloud(300, seed=4)
    world, _ = cloud.mapped([pose_at()], sigma=0.0)
    view, aside = world.keyframes[0], pose_at(0.02)
    off = []
    for taken_ns in (0, 60_000_000_000):
        expected = Prediction(aside.copy(), np.eye(6) * 1e6)
        frame = TrackedFrame.of_keyframe(view, 300)
        frame.expected, frame.taken_ns = expected, taken_ns
        refit(world, frame, pose_at(), PoseFromMap(FACTORS, proven_after_s=1.0))
        off.append(np.linalg.norm(frame.world_from_camera[:3, 3]))
    assert off[1] < 0.5 * off[0]


def test_a_pixel_of_a_higher_level_says_as_much_less_as_it_is_larger():
    world, _ = Cloud(300, seed=4).mapped([pose_at()], sigma=0.0)
    view = world.keyframes[0]
    keypoints = view.observed()
    rows = world.points.rows(view.points[keypoints])
    spread = []
    for level in (0, 3):
        view.features.octaves[:] = level
        found = PoseFromMap(FACTORS).estimate(world, View(CAMERA, view.features), pose_at(), rows, keypoints)
        spread.append(found.covariance)
    assert spread[1] == pytest.approx(FACTORS[3] ** 2 * spread[0], rel=1e-6, abs=1e-12)
