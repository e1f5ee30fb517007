"""Finding a lost camera in a map."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from prism_edge.config import TrackingConfig
from prism_edge.geometry.poses import inverse, rotation_angle, se3_log
from prism_edge.sources.sim import SimSource
from prism_edge.tracking.features import Features
from prism_edge.tracking.frame_tracking import FrameTracker, TrackedFrame
from prism_edge.tracking.motion import Prediction
from prism_edge.tracking.recovery import clearly_better, locate, match_keyframe, misled, recover
from prism_edge.tracking.tracker import Tracker
from prism_edge.tracking.view import View
from tests.tracking.cloud import CAMERA, FACTORS, Cloud, descriptors, flipped, pose_at
from tests.tracking.footage import IDENTITY


@pytest.fixture
def map_and_cloud():
    cloud = Cloud(400, seed=0)
    return cloud.mapped([np.eye(4)])[0], cloud


def test_it_finds_a_camera_far_from_where_it_was_last_seen(map_and_cloud):
    world, cloud = map_and_cloud
    true = pose_at(0.8, -0.3, 0.5, 0.1, -0.25, 0.3)
    features, shown = cloud.view(true, noise_px=0.5, bits=20)
    assert len(shown) > 50
    pose = locate(world, View(CAMERA, features), world.keyframes[0], seed=0)
    assert np.abs(se3_log(inverse(true) @ pose)).max() < 0.02
    again = locate(world, View(CAMERA, features), world.keyframes[0], seed=0)
    assert np.array_equal(pose, again)


def test_of_two_corners_that_look_like_one_point_it_is_the_liker(map_and_cloud):
    """A chair like the next: the other is no match, however near it comes to one."""
    world, cloud = map_and_cloud
    features, _ = cloud.view(pose_at(0.3))
    words = np.concatenate([flipped(cloud.rng, features.descriptors, 40), features.descriptors])
    twice = np.tile(features.pixels, (2, 1)), np.tile(features.octaves, 2)
    keypoints, ids = match_keyframe(Features.build(*twice, words, 640, 480), world.keyframes[0])
    assert len(ids) > 100
    assert len(np.unique(ids)) == len(ids)
    assert (keypoints >= len(features)).all()


def test_matches_are_mutual_and_right(map_and_cloud):
    world, cloud = map_and_cloud
    features, shown = cloud.view(pose_at(0.3), bits=20)
    keypoints, ids = match_keyframe(features, world.keyframes[0])
    assert len(keypoints) > 0.9 * len(shown) * 0.8
    assert len(np.unique(keypoints)) == len(np.unique(ids)) == len(ids)
    rows = world.points.rows(ids)
    assert np.array_equal(world.points.position[rows], cloud.positions[shown[keypoints]])


def test_a_third_of_moved_corners_does_no_harm(map_and_cloud):
    world, cloud = map_and_cloud
    true = pose_at(0.2, 0.1, 0.0, 0.0, 0.1, 0.0)
    features, _ = cloud.view(true, noise_px=0.5)
    wrong = cloud.rng.permutation(len(features))[: len(features) // 3]
    features.pixels[wrong] = cloud.rng.uniform((0, 0), (640, 480), (len(wrong), 2))
    pose = locate(world, View(CAMERA, features), world.keyframes[0], seed=1)
    assert np.abs(se3_log(inverse(true) @ pose)).max() < 0.02


def test_another_place_is_not_found(map_and_cloud):
    world, _ = map_and_cloud
    features, _ = Cloud(400, seed=99).view(np.eye(4))
    assert locate(world, View(CAMERA, features), world.keyframes[0], seed=0) is None


def test_the_right_descriptors_at_random_places_are_not_found(map_and_cloud):
    world, cloud = map_and_cloud
    features, _ = cloud.view(np.eye(4))
    features.pixels[:] = cloud.rng.uniform((0, 0), (640, 480), features.pixels.shape)
    assert locate(world, View(CAMERA, features), world.keyframes[0], seed=0) is None


def test_fourteen_that_agree_are_too_few(map_and_cloud):
    world, cloud = map_and_cloud
    features, _ = cloud.view(np.eye(4))
    keep = cloud.rng.permutation(len(features))[:20]
    few = Features.build(
        features.pixels[keep], features.octaves[keep], features.descriptors[keep], CAMERA.width, CAMERA.height
    )
    assert locate(world, View(CAMERA, few), world.keyframes[0], seed=0) is not None
    few.pixels[14:] = cloud.rng.uniform((0, 0), (640, 480), (6, 2))
    assert locate(world, View(CAMERA, few), world.keyframes[0], seed=0) is None


@pytest.mark.parametrize("count", [0, 1, 10, 100])
def test_garbage_is_not_found(map_and_cloud, count):
    world, cloud = map_and_cloud
    pixels = cloud.rng.uniform((0, 0), (640, 480), (count, 2))
    features = Features.build(pixels, np.zeros(count, np.intp), descriptors(cloud.rng, count), 640, 480)
    assert locate(world, View(CAMERA, features), world.keyframes[0], seed=0) is None


def test_a_keyframe_without_points_finds_nothing(map_and_cloud):
    world, cloud = map_and_cloud
    features, _ = cloud.view(np.eye(4))
    world.keyframes[0].points[:] = -1
    assert locate(world, View(CAMERA, features), world.keyframes[0], seed=0) is None


@pytest.mark.parametrize("place", [0.0, np.nan])
def test_points_that_fix_no_pose_give_none(map_and_cloud, place):
    """All on one spot, and not numbers at all."""
    world, cloud = map_and_cloud
    features, _ = cloud.view(np.eye(4))
    world.points.position[:] = place
    pose = locate(world, View(CAMERA, features), world.keyframes[0], seed=0)
    assert pose is None


@pytest.mark.parametrize(
    ("expected_at", "proven", "found"),
    [(0.0, 0.0, False), (0.0, 0.15, False), (0.0, 0.4, True), (0.3, 0.0, True), (None, 0.0, True)],
    ids=["young points", "a few old ones", "many old ones", "where it may have gone", "nothing expected"],
)
def test_where_the_camera_cannot_have_gone_only_points_that_have_stood_say_it_is(expected_at, proven, found):
    """What moves in front of it looks like its map, too."""
    cloud, true = Cloud(400, seed=0), pose_at(0.3)
    world, _ = cloud.mapped([np.eye(4)])
    table, now_ns = world.points, 10_000_000_000
    world.newest().stamp_ns = now_ns
    old = np.random.default_rng(0).random(len(table)) < proven
    table.born_ns[:] = np.where(old, 0, now_ns - 100_000_000)
    frames = FrameTracker(FACTORS, 5000, proven_after_s=1.5)
    if expected_at is not None:
        frames.expected = Prediction(pose_at(expected_at), np.eye(6) * 1e4)  # a centimetre
    frame = recover(world, frames, View(CAMERA, cloud.view(true, noise_px=0.3)[0]), world.newest(), 25, 0)
    assert (frame is not None) == found
    if frame is not None:
        assert np.abs(se3_log(inverse(true) @ frame.world_from_camera)).max() < 0.02


@pytest.mark.parametrize("far", [0.0, 0.4])
def test_old_points_that_are_where_they_were_expected_do_not_bear_it_out(far):
    """Far ones go with what moves near the camera, as they would with any way of its own."""
    cloud, true = Cloud(400, seed=0), pose_at(0.3)
    is_far = np.random.default_rng(0).random(400) < far
    cloud.positions[is_far] *= 50.0
    world, _ = cloud.mapped([np.eye(4)])
    table, now_ns = world.points, 10_000_000_000
    world.newest().stamp_ns = now_ns
    away = table.position[:, 2] > 20.0
    old = away if far else np.random.default_rng(1).random(len(table)) < 0.4
    table.born_ns[:] = np.where(old, 0, now_ns - 100_000_000)
    frames = FrameTracker(FACTORS, 5000, proven_after_s=1.5)
    frames.expected = Prediction(np.eye(4), np.eye(6) * 1e4)
    features = cloud.view(true, noise_px=0.3)[0]
    assert old.mean() > 0.3
    assert (recover(world, frames, View(CAMERA, features), world.newest(), 25, 0) is None) == bool(far)
    frames.expected = None
    assert recover(world, frames, View(CAMERA, features), world.newest(), 25, 0) is not None


def _placed(matched):
    return TrackedFrame.of_keyframe(Cloud(40, seed=0).mapped([np.eye(4)])[0].keyframes[0], matched)


def test_it_is_found_by_a_keyframe_beside_the_newest():
    """Of which nothing is recognised; nor does what was looked for last help."""
    cloud, true = Cloud(400, seed=0), pose_at(0.3, -0.1, 0.2, 0.05, -0.1, 0.2)
    world, _ = cloud.mapped([np.eye(4), pose_at(0.1)])
    newest, features = world.newest(), cloud.view(true, noise_px=0.3, bits=15)[0]
    for known in (True, False):
        frame = recover(world, FrameTracker(FACTORS, 5000), View(CAMERA, features), newest, 25, 0)
        assert np.abs(se3_log(inverse(true) @ frame.world_from_camera)).max() < 0.02, known
        others = descriptors(cloud.rng, len(newest.features))
        newest.features = Features.build(newest.features.pixels, newest.features.octaves, others, 640, 480)
    assert locate(world, View(CAMERA, features), newest, seed=0) is None


def test_a_sudden_loss_of_points_is_looked_at_again():
    assert misled(None, None, 25)
    assert misled(_placed(24), None, 25)
    assert not misled(_placed(25), None, 25)
    assert misled(_placed(113), _placed(600), 25)
    assert not misled(_placed(300), _placed(600), 25)
    assert not misled(_placed(40), _placed(40), 25)


def test_a_placement_gives_way_to_one_that_clearly_more_points_agree_with():
    few, as_few, many = _placed(44), _placed(45), _placed(183)
    assert clearly_better(few, many) is many
    assert clearly_better(few, as_few) is few
    assert clearly_better(few, None) is few
    assert clearly_better(None, few) is few
    assert clearly_better(None, None) is None


@pytest.mark.parametrize(
    ("seed", "way", "index"),
    [(0, "path=wheeled&speed=0.8", 8), (8, "path=wheeled&speed=0.8", 8), (23, "path=wheeled&speed=1", 5)],
)
def test_a_camera_that_turned_before_its_first_map_came_is_not_placed_by_chance(seed, way, index):
    with SimSource(f"sim:room?seed={seed}&{way}&width=320&height=240") as source:
        grey = [cv2.cvtColor(source.image(i).pixels, cv2.COLOR_BGR2GRAY) for i in (0, index)]
        tracker = Tracker(TrackingConfig())
        tracker.process(0, 0, grey[0], source.camera)
        keyframe = tracker.maybe_keyframe()
        tracker.add_depth(keyframe.id, source.depth(0), IDENTITY, 0.27)
        result = tracker.process(index, round(index * 1e9 / 30), grey[1], source.camera)
        off = inverse(inverse(source.pose(0)) @ source.pose(index)) @ result.world_from_camera
    assert np.degrees(rotation_angle(off[:3, :3])) < 1.5
    assert np.linalg.norm(off[:3, 3]) < 0.05
