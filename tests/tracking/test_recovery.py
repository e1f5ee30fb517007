"""Finding a lost camera in a map."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.poses import inverse, se3_log
from prism_edge.tracking.features import Features
from prism_edge.tracking.recovery import locate, match_keyframe
from tests.tracking.cloud import CAMERA, Cloud, descriptors, pose_at


@pytest.fixture
def map_and_cloud():
    cloud = Cloud(400, seed=0)
    return cloud.mapped([np.eye(4)])[0], cloud


def test_it_finds_a_camera_far_from_where_it_was_last_seen(map_and_cloud):
    world, cloud = map_and_cloud
    true = pose_at(0.8, -0.3, 0.5, 0.1, -0.25, 0.3)
    features, shown = cloud.view(true, noise_px=0.5, bits=20)
    assert len(shown) > 50
    pose = locate(world, CAMERA, features, world.keyframes[0], seed=0)
    assert np.abs(se3_log(inverse(true) @ pose)).max() < 0.02
    again = locate(world, CAMERA, features, world.keyframes[0], seed=0)
    assert np.array_equal(pose, again)


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
    pose = locate(world, CAMERA, features, world.keyframes[0], seed=1)
    assert np.abs(se3_log(inverse(true) @ pose)).max() < 0.02


def test_another_place_is_not_found(map_and_cloud):
    world, _ = map_and_cloud
    features, _ = Cloud(400, seed=99).view(np.eye(4))
    assert locate(world, CAMERA, features, world.keyframes[0], seed=0) is None


def test_the_right_descriptors_at_random_places_are_not_found(map_and_cloud):
    world, cloud = map_and_cloud
    features, _ = cloud.view(np.eye(4))
    features.pixels[:] = cloud.rng.uniform((0, 0), (640, 480), features.pixels.shape)
    assert locate(world, CAMERA, features, world.keyframes[0], seed=0) is None


def test_fourteen_that_agree_are_too_few(map_and_cloud):
    world, cloud = map_and_cloud
    features, _ = cloud.view(np.eye(4))
    keep = cloud.rng.permutation(len(features))[:20]
    few = Features.build(
        features.pixels[keep], features.octaves[keep], features.descriptors[keep], CAMERA.width, CAMERA.height
    )
    assert locate(world, CAMERA, few, world.keyframes[0], seed=0) is not None
    few.pixels[14:] = cloud.rng.uniform((0, 0), (640, 480), (6, 2))
    assert locate(world, CAMERA, few, world.keyframes[0], seed=0) is None


@pytest.mark.parametrize("count", [0, 1, 10, 100])
def test_garbage_is_not_found(map_and_cloud, count):
    world, cloud = map_and_cloud
    pixels = cloud.rng.uniform((0, 0), (640, 480), (count, 2))
    features = Features.build(pixels, np.zeros(count, np.intp), descriptors(cloud.rng, count), 640, 480)
    assert locate(world, CAMERA, features, world.keyframes[0], seed=0) is None


def test_a_keyframe_without_points_finds_nothing(map_and_cloud):
    world, cloud = map_and_cloud
    features, _ = cloud.view(np.eye(4))
    world.keyframes[0].points[:] = -1
    assert locate(world, CAMERA, features, world.keyframes[0], seed=0) is None


@pytest.mark.parametrize("place", [0.0, np.nan])
def test_points_that_fix_no_pose_give_none(map_and_cloud, place):
    """All on one spot, and not numbers at all."""
    world, cloud = map_and_cloud
    features, _ = cloud.view(np.eye(4))
    world.points.position[:] = place
    pose = locate(world, CAMERA, features, world.keyframes[0], seed=0)
    assert pose is None
