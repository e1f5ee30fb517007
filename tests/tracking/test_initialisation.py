"""Structure from two views, against a cloud whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import inverse, rotation_angle, se3_exp, transform
from prism_edge.tracking.initialisation import (
    MIN_POINTS,
    REPROJECTION_PX,
    _reprojects,
    essential_pose,
    reconstruct,
)

CAMERA = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
SECOND = se3_exp(np.array([0.5, 0.1, 0.2, 0.02, -0.06, 0.03]))  # first_from_second


def views(first_from_second, noise_px=0.3, seed=0, count=300):
    """Matched pixels of points 2 to 8 m away, seen by both cameras, and their depths in the first."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-3, -2, 2), (3, 2, 8), (4 * count, 3))
    other = transform(inverse(first_from_second), points)
    a, b = CAMERA.project(points), CAMERA.project(other)
    seen = np.all([(p > 0).all(1) & (p < (640, 480)).all(1) for p in (a, b)], axis=0) & (other[:, 2] > 0.5)
    chosen = np.flatnonzero(seen)[:count]
    noise = rng.normal(0, noise_px, (2, len(chosen), 2))
    return a[chosen] + noise[0], b[chosen] + noise[1], points[chosen]


def test_pose_and_points_come_out_in_the_unit_of_the_given_depths():
    first, second, points = views(SECOND)
    found = reconstruct(CAMERA, first, second, 2.5 * points[:, 2], SECOND, seed=0)
    assert found is not None
    assert rotation_angle(found.first_from_second[:3, :3].T @ SECOND[:3, :3]) < np.radians(0.5)
    moved, truth = found.first_from_second[:3, 3], SECOND[:3, 3]
    assert np.linalg.norm(moved) == pytest.approx(2.5 * np.linalg.norm(truth), rel=0.06)
    assert moved @ truth > np.cos(np.radians(6)) * np.linalg.norm(moved) * np.linalg.norm(truth)
    wide = found.good & (found.parallax > np.radians(3))
    error = np.linalg.norm(found.points - 2.5 * points, axis=1) / (2.5 * points[:, 2])
    assert np.median(error[wide]) < 0.05
    assert found.depth_spread < 0.05
    assert not found.contradicts


def test_the_spread_tells_how_far_the_given_depths_can_be_believed():
    first, second, points = views(SECOND, noise_px=0.1)
    scattered = points[:, 2] * np.exp(np.random.default_rng(1).normal(0, 0.6, len(points)))
    found = reconstruct(CAMERA, first, second, scattered, SECOND, seed=0)
    assert found is not None
    assert found.depth_spread == pytest.approx(0.6, rel=0.25)


def test_a_third_of_wrong_matches_does_no_harm():
    first, second, points = views(SECOND)
    wrong = np.arange(0, len(second), 3)
    second[wrong] = np.random.default_rng(2).uniform((0, 0), (640, 480), (len(wrong), 2))
    found = reconstruct(CAMERA, first, second, points[:, 2], SECOND, seed=0)
    assert found is not None
    assert rotation_angle(found.first_from_second[:3, :3].T @ SECOND[:3, :3]) < np.radians(0.5)
    assert found.good[wrong].mean() < 0.1
    length = np.linalg.norm(SECOND[:3, 3])  # their depths, which are right, say nothing of the unit
    assert np.linalg.norm(found.first_from_second[:3, 3]) == pytest.approx(length, rel=0.06)


@pytest.mark.parametrize("noise_px", [0.0, 0.5])
def test_a_turn_without_a_baseline_gives_nothing(noise_px):
    turned = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.02]))
    first, second, points = views(turned, noise_px)
    found = reconstruct(CAMERA, first, second, points[:, 2], SECOND, seed=0)
    # Noise can feign a short baseline, never a structure that agrees with the depths.
    assert found is None or found.depth_spread > 0.2


def test_too_few_or_degenerate_matches_give_nothing():
    first, second, points = views(SECOND, count=40)
    assert reconstruct(CAMERA, first, second, points[:, 2], SECOND, seed=0) is None
    spot = np.full((200, 2), 100.0)
    assert reconstruct(CAMERA, spot, spot, np.ones(200), SECOND, seed=0) is None


def test_one_seed_gives_one_answer():
    first, second, points = views(SECOND, noise_px=1.0)
    a, b = (reconstruct(CAMERA, first, second, points[:, 2], SECOND, seed=3) for _ in range(2))
    assert a is not None
    assert b is not None
    assert np.array_equal(a.points, b.points)


def test_a_pose_tracked_at_wrong_depths_does_not_mislead():
    first, second, points = views(SECOND)
    wrong = se3_exp(np.array([0.1, -0.2, 0.5, 0.0, 0.03, -0.04]))
    flat = np.full(len(points), 3.0)  # a network at a loss
    found = reconstruct(CAMERA, first, second, flat, wrong, seed=0)
    assert found is not None
    assert found.contradicts
    assert rotation_angle(found.first_from_second[:3, :3].T @ SECOND[:3, :3]) < np.radians(0.5)


def test_matches_that_fit_two_motions_follow_the_tracked_one():
    """Little parallax on a nearly flat scene: an essential matrix from it is anybody's guess."""
    rng = np.random.default_rng(7)
    truth = se3_exp(np.array([0.0, 0.0, 0.12, 0.0, 0.0, 0.0]))
    points = rng.uniform((-1.5, -1.1, 2.0), (1.5, 1.1, 2.3), (400, 3))
    a = CAMERA.project(points) + rng.normal(0, 0.5, (400, 2))
    b = CAMERA.project(transform(inverse(truth), points)) + rng.normal(0, 0.5, (400, 2))
    found = reconstruct(CAMERA, a, b, points[:, 2], truth, seed=0)
    assert found is not None
    assert np.linalg.norm(found.first_from_second[:3, 3] - truth[:3, 3]) < 0.03


def test_an_object_that_moves_does_not_contradict_a_motion_that_most_matches_agree_with():
    first, second, points = views(SECOND)
    moving = np.arange(0, len(second), 4)
    second[moving] += (40.0, 25.0)  # all alike, as what is carried past the camera
    found = reconstruct(CAMERA, first, second, points[:, 2], SECOND, seed=0)
    assert found is None or not found.contradicts


def test_nor_does_one_that_half_of_the_matches_lie_on():
    """However far it moves: a match that is off is off."""
    first, second, points = views(SECOND)
    nearest = np.argsort(np.hypot(*(first - (450.0, 200.0)).T))
    second[nearest[: len(second) // 2]] += (60.0, 0.0)
    found = reconstruct(CAMERA, first, second, points[:, 2], SECOND, seed=0)
    assert found is not None
    assert rotation_angle(found.first_from_second[:3, :3].T @ SECOND[:3, :3]) > np.radians(2), "it leads"
    assert not found.contradicts


def test_a_wrong_motion_that_few_matches_agree_with_is_contradicted_beside_one():
    first, second, points = views(SECOND)
    moving = np.arange(0, len(second), 4)
    second[moving] += (40.0, 25.0)
    wrong = se3_exp(np.array([0.1, -0.2, 0.5, 0.0, 0.03, -0.04]))
    found = reconstruct(CAMERA, first, second, points[:, 2], wrong, seed=0)
    assert found is not None
    assert found.contradicts
    assert rotation_angle(found.first_from_second[:3, :3].T @ SECOND[:3, :3]) < np.radians(0.5)


def test_neither_do_matches_that_agree_with_no_motion_hide_it():
    """Two thirds match something else; what is left fits a motion that is 0.3 degrees off less well."""
    first, second, points = views(SECOND)
    wrong = np.arange(200)
    second[wrong] = np.random.default_rng(2).uniform((0, 0), (640, 480), (200, 2))
    off = SECOND @ se3_exp(np.array([0.0, 0.0, 0.0, 0.005, 0.0, 0.0]))
    found = reconstruct(CAMERA, first, second, points[:, 2], off, seed=0)
    assert found is not None
    assert found.contradicts


def test_a_way_that_was_tracked_the_wrong_way_round_is_turned_round():
    """Epipolar lines are the same: only that the points are before both cameras tells."""
    first, second, points = views(SECOND)
    back = SECOND.copy()
    back[:3, 3] *= -1.0
    found = reconstruct(CAMERA, first, second, points[:, 2], back, seed=0)
    assert found is not None
    assert np.linalg.norm(found.first_from_second[:3, 3] - SECOND[:3, 3]) < 0.03


def test_some_depths_are_enough_for_the_unit():
    first, second, points = views(SECOND)
    depths = np.where(np.arange(len(points)) % 10 == 0, 2.5 * points[:, 2], np.nan)
    found = reconstruct(CAMERA, first, second, depths, SECOND, seed=0)
    assert found is not None
    assert np.linalg.norm(found.first_from_second[:3, 3]) == pytest.approx(
        2.5 * np.linalg.norm(SECOND[:3, 3]), rel=0.08
    )
    none = reconstruct(CAMERA, first, second, np.full(len(points), np.nan), SECOND, seed=0)
    assert none is None


def test_exact_points_reproject_and_those_a_few_pixels_off_do_not():
    camera = Camera(640, 480, 525.0, 460.0, 310.0, 250.0)
    points = np.random.default_rng(0).uniform((-2, -1.5, 3), (2, 1.5, 8), (100, 3))
    pixels = camera.project(transform(inverse(SECOND), points))
    assert _reprojects(camera, SECOND, points, pixels).all()
    for axis in ((1.0, 0.0), (0.0, 1.0)):
        off = (REPROJECTION_PX + 1.0) * np.array(axis)
        assert not _reprojects(camera, SECOND, points, pixels + off).any()


def test_an_essential_matrix_alone_says_where_the_second_view_is_in_the_first():
    """Not the first in the second: what is refined from there may end in another valley."""
    first, second, _ = views(SECOND)
    found = essential_pose(CAMERA, first, second, seed=0)
    assert found is not None
    pose, fits = found
    assert fits.mean() > 0.8
    assert rotation_angle(pose[:3, :3].T @ SECOND[:3, :3]) < np.radians(1.0)
    assert pose[:3, 3] @ SECOND[:3, 3] > np.cos(np.radians(10.0)) * np.linalg.norm(SECOND[:3, 3])


def test_few_points_with_parallax_are_no_structure():
    """Those that are far, however many, tell of a turn alone."""
    rng = np.random.default_rng(4)
    near, far = 40, 300
    assert near < MIN_POINTS
    depths = np.r_[rng.uniform(2.0, 4.0, near), rng.uniform(200.0, 300.0, far)]
    plane = rng.uniform((-0.4, -0.3), (0.4, 0.3), (near + far, 2))
    points = np.column_stack([plane, np.ones(near + far)]) * depths[:, None]
    first, second = CAMERA.project(points), CAMERA.project(transform(inverse(SECOND), points))
    assert reconstruct(CAMERA, first, second, depths, SECOND, seed=0) is None
    assert reconstruct(CAMERA, first, second, depths, SECOND, seed=0, least=near - 10) is not None
