"""Applying the backend's corrections to the local map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.geometry.poses import inverse, se3_log, transform
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.keyframe_culling import drop_keyframe
from prism_edge.tracking.map_correction import (
    MIN_COMMON,
    apply_correction,
    fit,
    refit,
    take_over,
)
from prism_edge.tracking.mapping import depth_sigma
from prism_edge.tracking.motion import Prediction
from prism_edge.tracking.pose_from_map import ENOUGH_TRIANGULATED
from prism_edge.tracking.submaps import Parts
from prism_edge.tracking.view import View
from tests.synthetic.messages import map_update
from tests.tracking.cloud import BY_POINTS, CAMERA, Cloud, check, pose_at

MOTION = pose_at(0.3, -0.2, 0.1, 0.02, 0.1, -0.05)
POSES = [pose_at(0.3 * i, 0.0, 0.0, 0.0, -0.04 * i) for i in range(6)]


def apply(world, based_on, keyframes, points, motion=MOTION, parallax_deg=0.0):
    """The correction that moves these keyframes and points rigidly."""
    rows = world.points.rows(points)
    # as they arrive: arrays that can't be written to
    poses = np.array([motion @ world.keyframes[k].world_from_camera for k in keyframes]).reshape(-1, 4, 4)
    positions = transform(motion, world.points.position[rows])
    parallax = np.full(len(points), parallax_deg, np.float32)
    for array in (poses, positions, parallax):
        array.flags.writeable = False
    update = map_update(
        based_on, keyframes=np.array(keyframes, np.int64), poses=poses,
        points=points, positions=positions, parallax_deg=parallax,
    )  # fmt: skip
    return apply_correction(world, update, BY_POINTS, Parts())


def test_a_rigid_motion_of_everything_moves_everything():
    cloud = Cloud(400, seed=0)
    world, _ = cloud.mapped(POSES)
    before = world.points.position.copy()
    motions = apply(world, 5, list(range(6)), world.points.ids.copy())
    assert sorted(motions) == list(range(6))
    assert np.array(list(motions.values())) == pytest.approx(np.tile(MOTION, (6, 1, 1)), abs=1e-9)
    for keyframe, pose in zip(world.keyframes.values(), POSES, strict=True):
        assert keyframe.world_from_camera == pytest.approx(MOTION @ pose, abs=1e-9)
    assert world.points.position == pytest.approx(transform(MOTION, before), abs=1e-9)
    check(world)


def test_points_the_backend_does_not_name_go_with_their_keyframe():
    cloud = Cloud(400, seed=0)
    world, _ = cloud.mapped(POSES)
    before = world.points.position.copy()
    named = world.points.ids[::3].copy()
    apply(world, 5, list(range(6)), named)
    assert world.points.position == pytest.approx(transform(MOTION, before), abs=1e-9)


def test_points_of_a_culled_keyframe_go_with_the_next_newer_one():
    cloud = Cloud(400, seed=0)
    world, _ = cloud.mapped(POSES)
    table, before = world.points, world.points.position.copy()
    del world.keyframes[2]
    named = np.zeros(0, np.int64)
    apply(world, 5, [3], named)
    moved = np.isin(table.reference, (2, 3))
    assert (table.reference == 2).any()
    assert table.position[moved] == pytest.approx(transform(MOTION, before[moved]), abs=1e-9)
    assert np.array_equal(table.position[~moved], before[~moved])


def test_newer_keyframes_are_fitted_to_the_corrected_points():
    """The backend had seen three of six; those it had not follow the points, and take theirs along."""
    cloud = Cloud(600, seed=1)
    world, _ = cloud.mapped(POSES)
    before = world.points.position.copy()
    known = world.points.ids[world.points.reference <= 2].copy()
    motion = apply(world, 2, [0, 1, 2], known)[5]
    for k in (3, 4, 5):
        error = se3_log(inverse(MOTION @ POSES[k]) @ world.keyframes[k].world_from_camera)
        assert np.abs(error).max() < 1e-4
    assert motion == pytest.approx(MOTION, abs=1e-4)
    assert world.points.position == pytest.approx(transform(MOTION, before), abs=2e-3)


def test_a_fit_absorbs_what_a_rigid_motion_would_carry_on():
    """A newer keyframe that was misplaced before comes right: carried rigidly it would stay wrong."""
    cloud = Cloud(600, seed=1)
    world, _ = cloud.mapped(POSES)
    world.keyframes[3].world_from_camera = POSES[3] @ pose_at(0.02, 0.01, -0.02, 0.005, 0.0, 0.0)
    known = world.points.ids[world.points.reference <= 2].copy()
    apply(world, 2, [0, 1, 2], known, motion=np.eye(4))
    assert np.abs(se3_log(inverse(POSES[3]) @ world.keyframes[3].world_from_camera)).max() < 1e-3


def test_points_are_as_sure_as_the_correction_makes_them_when_newer_keyframes_are_fitted():
    """Seeds of the network's that the backend has placed since are no seeds any more."""
    fitted = []
    for sigma in (0.3, depth_sigma(CAMERA.fx, np.radians(5.0))):
        world, _ = Cloud(600, seed=1).mapped(POSES, noise_px=1.0)
        named = world.points.reference <= 2
        known = world.points.ids[named].copy()
        world.points.log_depth_sigma[named] = sigma
        apply(world, 2, [0, 1, 2], known, parallax_deg=5.0)
        fitted.append([world.keyframes[k].world_from_camera for k in (3, 4, 5)])
    assert np.array(fitted[0]) == pytest.approx(np.array(fitted[1]), abs=1e-9)


def test_a_newer_keyframe_also_holds_on_to_what_was_taken_along():
    """The backend moved a handful of points in one corner, and not quite well: that must not turn a view."""
    world, _ = Cloud(600, seed=4).mapped(POSES)
    table = world.points
    direction = table.position[:, :2] / table.position[:, 2:]
    corner = table.ids[np.linalg.norm(direction - (0.3, 0.2), axis=1) < 0.12][:30].copy()
    assert 20 < len(corner) <= 30
    table.position[table.rows(corner)] += np.random.default_rng(4).normal(0.0, 0.01, (len(corner), 3))
    apply(world, 2, [0, 1, 2], corner)
    for k in (3, 4, 5):
        error = se3_log(inverse(MOTION @ POSES[k]) @ world.keyframes[k].world_from_camera)
        assert np.abs(error).max() < 2e-3


def test_a_part_that_a_loop_joins_grows_with_all_that_the_backend_does_not_name():
    """It was a fifth too small, with a keyframe and its points that are still on their way to the backend."""
    cloud, growth = Cloud(600, seed=1), 1.25
    world, _ = cloud.mapped(POSES)
    table, true = world.points, world.points.position.copy()
    part = table.reference >= 3
    smaller = inverse(MOTION)
    table.position[part] = transform(smaller, true[part]) / growth
    for k, keyframe in world.keyframes.items():
        other = part if k < 3 else ~part  # what the one has seen the other has not
        keyframe.points[np.isin(keyframe.points, table.ids[other])] = -1
        if k >= 3:
            keyframe.world_from_camera = smaller @ POSES[k]
            keyframe.world_from_camera[:3, 3] /= growth
    last = inverse(MOTION) @ POSES[5]
    last[:3, 3] /= growth
    named = table.ids[part & (table.reference < 5)][::3].copy()
    update = map_update(
        4, keyframes=np.array([3, 4]), poses=np.array([POSES[3], POSES[4]]),
        points=named, positions=true[table.rows(named)], parallax_deg=np.zeros(len(named), np.float32),
        loop_query=4, loop_candidate=1, loop_units=np.array([np.log(growth), 0.01]),
    )  # fmt: skip
    parts = Parts.given({3: 3, 4: 3, 5: 3})
    parts.current = 3
    for keyframe in world.keyframes.values():
        keyframe.twist = np.ones(6)
    motion = apply_correction(world, update, BY_POINTS, parts)[5]
    moving = [world.keyframes[k].twist.tolist() for k in (2, 3, 5)]
    assert moving == [[1.0] * 6, [growth] * 3 + [1.0] * 3, [growth] * 3 + [1.0] * 3]
    assert table.position == pytest.approx(true, abs=5e-3)
    assert world.keyframes[5].world_from_camera == pytest.approx(POSES[5], abs=2e-3)
    assert transform(motion, last[:3, 3][None])[0] == pytest.approx(POSES[5][:3, 3], abs=5e-3)


def test_what_sees_nothing_known_goes_with_the_fitted_keyframe_before_it():
    """Both were misplaced alike: the fit of the one puts the other right, too."""
    world, _ = Cloud(600, seed=1).mapped(POSES[:5])
    wrong = pose_at(0.02, 0.01, -0.02, 0.005)
    for k in (3, 4):
        world.keyframes[k].world_from_camera = wrong @ POSES[k]
    world.keyframes[4].points[:] = -1
    known = world.points.ids[world.points.reference <= 2].copy()
    apply(world, 2, [0, 1, 2], known, motion=np.eye(4))
    for k in (3, 4):
        assert np.abs(se3_log(inverse(POSES[k]) @ world.keyframes[k].world_from_camera)).max() < 1e-3


def test_what_went_with_the_newest_keyframe_does_no_harm():
    """A part that is given up goes with the points it alone saw; they have a row still."""
    world, _ = Cloud(400, seed=0).mapped(POSES)
    drop_keyframe(world, world.keyframes[5])
    table, before = world.points, world.points.position.copy()
    assert (table.reference == 5).any()
    apply(world, 4, list(range(5)), np.zeros(0, np.int64))
    assert table.position[table.alive] == pytest.approx(transform(MOTION, before[table.alive]), abs=1e-9)


def test_newer_keyframes_that_share_too_little_are_carried():
    cloud = Cloud(400, seed=2)
    world, _ = cloud.mapped(POSES[:2])
    far, _ = cloud.keyframe(2, POSES[1] @ pose_at(0, 0, 0, 0, 0.1))
    world.add_keyframe(far)  # sees nothing of the map
    old = far.world_from_camera.copy()
    motion = apply(world, 1, [0, 1], world.points.ids.copy())[2]
    assert far.world_from_camera == pytest.approx(MOTION @ old, abs=1e-9)
    assert motion == pytest.approx(MOTION, abs=1e-9)


def test_older_keyframes_outside_the_window_stay():
    cloud = Cloud(400, seed=0)
    world, _ = cloud.mapped(POSES)
    mine = world.points.reference <= 1
    before = world.points.position[mine].copy()
    apply(world, 5, [2, 3, 4, 5], world.points.ids[~mine].copy())
    for k in (0, 1):
        assert np.array_equal(world.keyframes[k].world_from_camera, POSES[k])
    assert np.array_equal(world.points.position[mine], before)


def test_what_is_gone_here_is_ignored():
    cloud = Cloud(300, seed=3)
    world, _ = cloud.mapped(POSES[:3])
    ids = world.points.ids.copy()
    world.cull_points(np.arange(20))
    dead = world.points.position[:20].copy()
    poses = np.array([MOTION @ POSES[0], np.eye(4)])
    named = np.r_[ids, [10_000, 20_000]]
    update = map_update(
        2, keyframes=np.array([0, 77]), poses=poses, points=named, positions=np.zeros((len(named), 3)),
        parallax_deg=np.zeros(len(named), np.float32),
    )  # fmt: skip
    apply_correction(world, update, BY_POINTS, Parts())
    assert 77 not in world.keyframes
    assert np.array_equal(world.points.position[:20], dead)
    assert not world.points.position[20:].any()
    check(world)


def test_parallax_only_grows_and_makes_points_firmer():
    cloud = Cloud(200, seed=4)
    world, _ = cloud.mapped(POSES[:3], sigma=0.2, parallax_deg=1.0)
    ids = world.points.ids.copy()
    apply(world, 2, [0, 1, 2], ids, np.eye(4), parallax_deg=4.0)
    assert world.points.parallax_deg == pytest.approx(4.0)
    # 1.4 px of disparity at 500 px of focal length, over 4 degrees
    assert world.points.log_depth_sigma == pytest.approx(1.4 / (500.0 * np.radians(4.0)))
    apply(world, 2, [0, 1, 2], ids, np.eye(4), parallax_deg=2.0)
    assert world.points.parallax_deg == pytest.approx(4.0)
    assert world.points.log_depth_sigma == pytest.approx(1.4 / (500.0 * np.radians(4.0)))
    world.points.log_depth_sigma[:] = 1e-3  # as a wider view here has made it since
    apply(world, 2, [0, 1, 2], ids, np.eye(4), parallax_deg=4.0)
    assert world.points.log_depth_sigma == pytest.approx(1e-3)


def test_what_the_backend_once_knew_it_knows_for_good():
    world, _ = Cloud(200, seed=4).mapped(POSES)
    for based_on in (4, 3):
        apply(world, based_on, [0, 1, 2], world.points.ids.copy())
        assert world.heard == 4


def test_a_newer_keyframe_of_another_part_stays_where_nothing_is_known_of_it():
    world, _ = Cloud(600, seed=1).mapped(POSES)
    own, table = world.points.reference == 5, world.points
    for k, keyframe in world.keyframes.items():
        keyframe.points[np.isin(keyframe.points, table.ids[own if k < 5 else ~own])] = -1
    places = table.position[own].copy()
    known = table.ids[~own].copy()
    update = map_update(
        4, keyframes=np.arange(5), poses=np.array([MOTION @ pose for pose in POSES[:5]]), points=known,
        positions=transform(MOTION, table.position[~own]), parallax_deg=np.zeros(len(known), np.float32),
    )  # fmt: skip
    apply_correction(world, update, BY_POINTS, Parts.given({5: 5}))
    assert own.any()
    assert world.keyframes[4].world_from_camera == pytest.approx(MOTION @ POSES[4], abs=1e-9)
    assert world.keyframes[5].world_from_camera == pytest.approx(POSES[5], abs=1e-9)
    assert table.position[own] == pytest.approx(places, abs=1e-9)


def test_a_view_that_few_of_its_points_fit_stays_where_it_was():
    world, _ = Cloud(300, seed=5).mapped(POSES[:1])
    keyframe, start = world.keyframes[0], pose_at(0.02)
    mixed, view = np.roll(keyframe.points, 7), View(CAMERA, keyframe.features)
    assert fit(world, view, mixed, start, BY_POINTS) == pytest.approx(start, abs=1e-12)


def test_observations_that_the_backend_found_wrong_are_given_up():
    world, _ = Cloud(200, seed=4).mapped(POSES)
    wrong = world.keyframes[2].points[world.keyframes[2].observed()[:5]].copy()
    dropped = {"dropped_keyframes": np.full(5, 2), "dropped_points": wrong}
    take_over(world, Parts(), map_update(5, **dropped), None, BY_POINTS)
    assert not np.isin(wrong, world.keyframes[2].points).any()
    check(world)


def test_a_view_of_few_usable_points_stays_where_it_was():
    cloud = Cloud(300, seed=5)
    world, _ = cloud.mapped(POSES[:1])
    features, _ = cloud.view(POSES[1])
    start = pose_at(0.5)
    nothing = np.full(len(features), -1, np.int64)
    assert fit(world, View(CAMERA, features), nothing, start, BY_POINTS) == pytest.approx(start, abs=1e-12)
    keyframe = world.keyframes[0]
    unusable = np.zeros(len(world.points), bool)
    unusable[:10] = True
    same = fit(world, View(CAMERA, keyframe.features), keyframe.points, start, BY_POINTS, unusable)
    assert same == pytest.approx(start, abs=1e-12)


def test_a_view_that_is_carried_a_thousand_times_stays_rigid():
    """Each correction is rigid to rounding only; a fit that could not be made must not let that add up."""
    cloud = Cloud(400, seed=0)
    world, _ = cloud.mapped(POSES)
    view = world.keyframes[5]
    nothing = np.zeros(len(world.points), bool)
    pose, step = POSES[5], MOTION * (1.0 + 1e-12)
    for _ in range(1000):
        new = fit(world, View(CAMERA, view.features), view.points, step @ pose, BY_POINTS, nothing)
        step = new @ inverse(pose)
        pose = new
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)


def test_a_newer_keyframe_is_not_fitted_to_points_of_its_own():
    """They are where it was before: many, they would hold it there."""
    world, _ = Cloud(600, seed=4).mapped(POSES[:4])
    last, table = world.keyframes[3], world.points
    shared = last.points[last.observed()]
    mine = shared[40:]  # as if it had triangulated them itself, and few of what others saw
    table.reference[table.rows(mine)] = 3
    known = table.ids[table.reference < 3].copy()
    apply(world, 2, [0, 1, 2], known)
    assert len(mine) > 3 * 40
    error = se3_log(inverse(MOTION @ POSES[3]) @ last.world_from_camera)
    assert np.abs(error).max() < 2e-3


def test_a_correction_that_changes_nothing_moves_no_view_of_doubtful_points() -> None:
    """A frame is placed by points as doubtful as they are; placed otherwise, it would seem to have moved."""
    cloud = Cloud(600, seed=6)
    world, _ = cloud.mapped([pose_at(0.0)])
    table, there = world.points, pose_at(0.2, 0.02, 0.05)
    seeds = np.arange(len(table)) % 3 != 0
    assert (~seeds).sum() >= ENOUGH_TRIANGULATED
    table.log_depth_sigma[seeds], table.parallax_deg[seeds] = 0.15, 0.1
    table.position[seeds] *= np.exp(cloud.rng.normal(0.05, 0.12, seeds.sum()))[:, None]  # along their rays
    features, shown = cloud.view(there, noise_px=1.0)
    ids = np.full(len(cloud.positions), -1, np.int64)
    ids[cloud.keyframe(0, pose_at(0.0))[1]] = world.keyframes[0].points
    keypoints = np.flatnonzero(ids[shown] >= 0)
    rows = table.rows(ids[shown][keypoints])
    placed = BY_POINTS.estimate(world, View(CAMERA, features), there, rows, keypoints)
    points = np.full(len(features), -1, np.int64)
    points[keypoints[placed.inliers]] = table.ids[rows[placed.inliers]]
    assert np.linalg.norm((placed.world_from_camera - there)[:3, 3]) < 0.005
    pose = placed.world_from_camera
    last = TrackedFrame(CAMERA, features, pose, points, np.zeros((6, 6)), int(placed.inliers.sum()))
    named = table.ids.copy()
    update = map_update(
        0, keyframes=np.array([0]), poses=pose_at(0.0)[None], points=named, positions=table.position.copy(),
        parallax_deg=np.zeros(len(named), np.float32),
    )  # fmt: skip
    take_over(world, Parts(), update, last, BY_POINTS)
    assert np.linalg.norm((last.world_from_camera - pose)[:3, 3]) < 0.0005


def test_a_frame_goes_with_the_keyframe_whose_points_it_sees() -> None:
    """Not with the newest, which is elsewhere where the camera is back at an old place."""
    cloud = Cloud(400, seed=0)
    world, _ = cloud.mapped(POSES)
    first, table = world.keyframes[0], world.points
    only = np.flatnonzero(np.isin(first.points, table.ids[table.observations == 1]))[: MIN_COMMON - 1]
    assert len(only) >= 5, "too few for a fit of its own"
    points = np.full(len(first.points), -1, np.int64)
    points[only] = first.points[only]
    last = TrackedFrame(CAMERA, first.features, POSES[0].copy(), points, np.zeros((6, 6)), len(only))
    nothing = np.zeros(0, np.int64)
    update = map_update(
        5, keyframes=np.array([5]), poses=(MOTION @ POSES[5])[None], points=nothing,
        positions=np.zeros((0, 3)), parallax_deg=np.zeros(0, np.float32),
    )  # fmt: skip
    take_over(world, Parts(), update, last, BY_POINTS)
    assert last.world_from_camera == pytest.approx(POSES[0], abs=1e-9)
    last.points = np.full(len(points), -1, np.int64)  # with nothing to tell, with the newest
    take_over(world, Parts(), replace(update, poses=(MOTION @ MOTION @ POSES[5])[None]), last, BY_POINTS)
    assert last.world_from_camera == pytest.approx(MOTION @ POSES[0], abs=1e-9)


def test_what_was_expected_of_a_frame_goes_with_its_surroundings() -> None:
    """Placed anew by its points alone, one that shows little would jump with every correction."""
    cloud = Cloud(500, seed=4)
    world, shown = cloud.mapped(POSES[:2])
    features, seen = cloud.view(POSES[1], noise_px=1.5)
    points = np.where(features.pixels[:, 0] < 90.0, world.keyframes[1].points[: len(seen)], -1)
    assert np.array_equal(seen, shown[1])
    expected = Prediction(POSES[1].copy(), np.eye(6) * 1e7)
    last = TrackedFrame(CAMERA, features, POSES[1].copy(), points, np.zeros((6, 6)), 99, expected=expected)
    apply(world, 1, [0, 1], world.points.ids)
    refit(world, last, MOTION @ POSES[1], BY_POINTS)
    assert np.abs(se3_log(inverse(MOTION @ POSES[1]) @ last.world_from_camera)).max() < 0.002
    assert last.expected.world_from_camera == pytest.approx(MOTION @ POSES[1])
    last.expected = None
    refit(world, last, last.world_from_camera, BY_POINTS)
    assert np.abs(se3_log(inverse(MOTION @ POSES[1]) @ last.world_from_camera)).max() > 0.005
