"""A camera's pose by points alone."""

from __future__ import annotations

import cv2
import numpy as np

from prism_edge.geometry.poses import inverse, se3_log
from prism_edge.tracking.perspective_pose import perspective_pose
from tests.tracking.cloud import CAMERA, Cloud, pose_at

TRUE = pose_at(0.4, -0.2, 0.3, 0.1, -0.2, 0.1)


def seen(wrong: int, noise_px: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Places of points and their pixels, the first ``wrong`` of them anywhere in the image."""
    cloud = Cloud(200, seed=0)
    features, shown = cloud.view(TRUE, noise_px)
    features.pixels[:wrong] = cloud.rng.uniform((0, 0), (640, 480), (wrong, 2))
    return cloud.positions[shown], features.pixels


def test_the_camera_is_where_most_points_say_and_again_by_the_same_seed() -> None:
    found = []
    for _ in range(2):
        cv2.setRNGSeed(3)
        found.append(perspective_pose(*seen(wrong=40), CAMERA.matrix, 4.0, 0.99, 15))
    assert np.abs(se3_log(inverse(TRUE) @ found[0])).max() < 0.02
    assert np.array_equal(*found)


def test_it_is_found_mostly_where_seven_of_ten_matches_are_wrong() -> None:
    """A lost camera's matches are by looks alone."""
    positions, pixels = seen(wrong=0, noise_px=1.0)
    right, found = len(pixels) * 3 // 10, 0
    for trial in range(20):
        rng = np.random.default_rng(trial)
        mixed = pixels.copy()
        wrong = rng.permutation(len(pixels))[right:]
        mixed[wrong] = rng.uniform((0, 0), (640, 480), (len(wrong), 2))
        cv2.setRNGSeed(trial)
        pose = perspective_pose(positions, mixed, CAMERA.matrix, 6.0, 0.99, 15)
        found += pose is not None and bool(np.abs(se3_log(inverse(TRUE) @ pose)).max() < 0.1)
    assert found >= 14


def test_too_few_that_agree_are_no_pose() -> None:
    positions, pixels = seen(wrong=0)
    assert perspective_pose(positions, pixels, CAMERA.matrix, 4.0, 0.99, len(pixels) + 1) is None


def test_points_on_one_spot_or_too_few_to_draw_from_are_no_pose() -> None:
    positions, pixels = seen(wrong=0)
    spot = np.tile(positions[:1], (20, 1)), np.tile(pixels[:1], (20, 1))
    assert perspective_pose(*spot, CAMERA.matrix, 4.0, 0.99, 15) is None
    assert perspective_pose(positions[:3], pixels[:3], CAMERA.matrix, 4.0, 0.99, 3) is None
