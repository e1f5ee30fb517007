"""Pose refinement against numerical derivatives, explicit covariances and repeated trials."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.geometry.poses import from_rt, inverse, rotation_angle, se3_exp, se3_log, transform
from prism_edge.tracking.motion import Prediction
from prism_edge.tracking.pose_refinement import PoseEstimate, refine_pose
from tests.tracking.cloud import CAMERA

TRUE = se3_exp(np.array([0.3, -0.2, 0.1, 0.1, -0.2, 0.05]))


def scene(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """World points (n, 3) in front of the true camera, and their exact pixels."""
    depth = rng.uniform(1.0, 5.0, count)
    local = np.column_stack([rng.uniform((-0.6, -0.45), (0.6, 0.45), (count, 2)) * depth[:, None], depth])
    return transform(TRUE, local), CAMERA.project(local)


def error_of(pose: np.ndarray) -> np.ndarray:
    """The right-hand twist from the true pose to another."""
    return se3_log(inverse(TRUE) @ pose)


def jacobian_of(point: np.ndarray) -> np.ndarray:
    """d(pixel)/d(right-hand twist of the pose) (2, 6), numerically."""
    columns = []
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        ahead, behind = (
            CAMERA.project(transform(inverse(TRUE @ se3_exp(sign * step)), point[None]))[0]
            for sign in (1.0, -1.0)
        )
        columns.append((ahead - behind) / 2e-6)
    return np.array(columns).T


def pixel_covariance(point: np.ndarray, sigma: float, error: np.ndarray) -> np.ndarray:
    """Noise of a pixel (2, 2) whose point is uncertain along ``error``, numerically."""
    ahead, behind = (
        CAMERA.project(transform(inverse(TRUE), (point + sign * 1e-6 * error)[None]))[0]
        for sign in (1.0, -1.0)
    )
    smear = (ahead - behind) / 2e-6
    return sigma**2 * np.eye(2) + np.outer(smear, smear)


@pytest.mark.parametrize("smeared", [False, True])
def test_information_and_chi2_are_those_of_explicit_matrices(smeared):
    """At one pose, without a step: Jacobians and whitening show in information, chi2 and inliers."""
    rng = np.random.default_rng(1)
    points, pixels = scene(rng, 60)
    pixels = pixels + rng.normal(0, 3.0, pixels.shape)
    sigmas, error = rng.uniform(1.0, 3.0, 60), np.zeros((60, 3))
    if smeared:
        error[5:] = rng.normal(0, 0.1, (55, 3))
    estimate = refine_pose(
        CAMERA, TRUE, points, pixels, sigmas, error if smeared else None, rounds=1, iterations=0
    )
    assert np.array_equal(estimate.world_from_camera, TRUE)
    information, chi2 = np.zeros((6, 6)), np.zeros(60)
    exact = CAMERA.project(transform(inverse(TRUE), points))
    for i in range(60):
        precision = np.linalg.inv(pixel_covariance(points[i], sigmas[i], error[i]))
        residual = pixels[i] - exact[i]
        chi2[i] = residual @ precision @ residual
        huber = min(1.0, np.sqrt(5.991 / chi2[i]))
        jacobian = jacobian_of(points[i])
        information += huber * jacobian.T @ precision @ jacobian
    assert np.linalg.inv(estimate.covariance) == pytest.approx(
        information, rel=1e-4, abs=1e-5 * np.abs(information).max()
    )
    inliers = chi2 < 5.991
    assert 10 < inliers.sum() < 60
    assert np.array_equal(estimate.inliers, inliers)


def test_exact_measurements_give_the_exact_pose():
    rng = np.random.default_rng(2)
    points, pixels = scene(rng, 60)
    start = TRUE @ se3_exp(np.array([0.05, -0.05, 0.08, 0.03, 0.02, -0.04]))
    estimate = refine_pose(CAMERA, start, points, pixels, np.ones(60), rounds=5, iterations=8)
    assert np.abs(error_of(estimate.world_from_camera)).max() < 1e-4
    assert estimate.inliers.all()


def test_thirty_percent_outliers_are_told_apart():
    rng = np.random.default_rng(3)
    points, pixels = scene(rng, 200)
    pixels = pixels + rng.normal(0, 0.7, pixels.shape)
    wrong = rng.permutation(200)[:60]
    pixels[wrong] += rng.uniform(15, 60, (60, 2)) * rng.choice((-1, 1), (60, 2))
    start = TRUE @ se3_exp(np.array([0.03, 0.02, -0.03, 0.01, -0.01, 0.02]))
    estimate = refine_pose(CAMERA, start, points, pixels, np.ones(200))
    assert np.linalg.norm(error_of(estimate.world_from_camera)[:3]) < 0.01
    assert rotation_angle((inverse(TRUE) @ estimate.world_from_camera)[:3, :3]) < 0.003
    assert not estimate.inliers[wrong].any()
    assert np.delete(estimate.inliers, wrong).mean() > 0.95


def test_outliers_that_all_pull_one_way_have_no_part_in_the_pose():
    """As something that moves does: told apart, they are left out of the rounds that follow."""
    rng = np.random.default_rng(3)
    points, pixels = scene(rng, 200)
    pixels[:40] += (12.0, 8.0)
    estimate = refine_pose(CAMERA, TRUE, points, pixels, np.ones(200), iterations=6)
    assert np.array_equal(estimate.inliers, np.arange(200) >= 40)
    assert np.abs(error_of(estimate.world_from_camera)).max() < 1e-6


def test_it_is_as_good_as_opencvs_least_squares():
    rng = np.random.default_rng(4)
    points, pixels = scene(rng, 80)
    # Below Huber's threshold both minimise the same sum of squares.
    pixels = pixels + rng.uniform(-1.0, 1.0, pixels.shape)
    estimate = refine_pose(CAMERA, TRUE, points, pixels, np.ones(80), iterations=8)
    start = inverse(TRUE)
    r, t = cv2.solvePnPRefineLM(
        points, pixels, CAMERA.matrix, None, cv2.Rodrigues(start[:3, :3])[0], start[:3, 3:].copy()
    )
    reference = inverse(from_rt(cv2.Rodrigues(r)[0], t.ravel()))
    assert np.abs(se3_log(inverse(reference) @ estimate.world_from_camera)).max() < 5e-4


@pytest.mark.parametrize("smeared", [False, True])
def test_covariance_is_that_of_repeated_trials(smeared):
    rng = np.random.default_rng(5)
    points, pixels = scene(rng, 80)
    sigmas = rng.uniform(0.8, 2.0, 80)
    direction = points - TRUE[:3, 3]
    smear = 0.02 * direction if smeared else None
    errors, claimed = [], []
    for _ in range(400):
        noisy = pixels + rng.normal(size=pixels.shape) * sigmas[:, None]
        seen_at = points if smear is None else points + smear * rng.normal(size=(80, 1))
        estimate = refine_pose(CAMERA, TRUE, seen_at, noisy, sigmas, smear)
        errors.append(error_of(estimate.world_from_camera))
        claimed.append(estimate.covariance)
    actual, stated = np.cov(np.array(errors).T), np.mean(claimed, axis=0)
    ratio = np.sqrt(np.diag(actual) / np.diag(stated))
    assert np.all((ratio > 0.8) & (ratio < 1.25)), ratio
    # Not only the diagonal: the whitened errors have unit covariance in every direction.
    root = np.linalg.inv(np.linalg.cholesky(stated))
    assert np.all(np.abs(np.sqrt(np.linalg.eigvalsh(root @ actual @ root.T)) - 1.0) < 0.3)


def test_a_point_of_weight_nothing_does_not_pull():
    rng = np.random.default_rng(6)
    points, pixels = scene(rng, 60)
    pixels[:20] += 2.0  # within the bound of an inlier, all to one side
    weights = np.r_[np.zeros(20), np.ones(40)]
    pulled = refine_pose(CAMERA, TRUE, points, pixels, np.ones(60)).world_from_camera
    free = refine_pose(CAMERA, TRUE, points, pixels, np.ones(60), weights=weights).world_from_camera
    assert np.abs(error_of(free)).max() < 1e-6
    assert np.abs(error_of(pulled)).max() > 1e-4


def test_a_step_that_makes_it_worse_is_taken_back_with_its_inliers_and_shorter_ones_are_tried():
    """From a metre off and more the first step may go too far."""
    rng, sigma, taken_back = np.random.default_rng(3), 40.0, 0
    for _ in range(60):
        points, pixels = scene(rng, 30)
        start = TRUE @ se3_exp(rng.normal(0.0, (1.2, 1.2, 1.2, 0.1, 0.1, 0.1)))
        one, more = (
            refine_pose(CAMERA, start, points, pixels, np.full(30, sigma), rounds=1, iterations=most)
            for most in (1, 6)
        )
        for found in (one, more):
            local = transform(inverse(found.world_from_camera), points)
            seen = (local[:, 2] > 1e-3) & (np.abs(local[:, :2]).max(axis=1) < 10.0 * local[:, 2])
            off = np.full(30, np.inf)
            off[seen] = np.linalg.norm(CAMERA.project(local[seen]) - pixels[seen], axis=1) / sigma
            assert np.array_equal(found.inliers, off**2 < 5.991)
        if np.array_equal(one.world_from_camera, start):
            taken_back += 1
            assert not np.array_equal(more.world_from_camera, start)
    assert taken_back >= 4, "else this says nothing"


def test_behind_is_no_way_out():
    """From a start that looks the other way, no step that hides points may count as better."""
    rng = np.random.default_rng(7)
    points, pixels = scene(rng, 50)
    for turn, ahead in ((np.pi, 0.0), (0.0, 20.0)):
        start = TRUE @ se3_exp(np.array([0, 0, ahead, 0, turn, 0]))
        estimate = refine_pose(CAMERA, start, points, pixels, np.ones(50))
        assert np.isfinite(estimate.world_from_camera).all()
        assert not estimate.inliers.any()
        assert np.isfinite(estimate.covariance).all()


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_few_points_give_numbers(count):
    rng = np.random.default_rng(8)
    points, pixels = scene(rng, count)
    estimate = refine_pose(CAMERA, TRUE, points, pixels + 0.5, np.ones(count))
    assert np.isfinite(estimate.world_from_camera).all()
    assert np.isfinite(estimate.covariance).all()
    assert estimate.inliers.shape == (count,)
    # What the points don't fix is said to be uncertain.
    if count < 3:
        assert np.linalg.eigvalsh(estimate.covariance).max() > 1e3


def test_points_on_one_spot_give_numbers():
    points = np.tile(transform(TRUE, np.array([[0.0, 0.0, 2.0]])), (30, 1))
    pixels = np.tile([[319.5, 239.5]], (30, 1))
    estimate = refine_pose(CAMERA, TRUE, points, pixels, np.ones(30), np.zeros((30, 3)))
    assert np.isfinite(estimate.world_from_camera).all()
    assert np.linalg.eigvalsh(estimate.covariance).max() > 1e3


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-6, 1.0, 1e8, 1e200]))
def test_absurd_points_and_starts_give_finite_numbers(seed, size):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(20, 3)) * size
    start = se3_exp(rng.normal(size=6) * min(size, 1e8))
    with np.errstate(all="ignore"):
        estimate = refine_pose(CAMERA, start, points, rng.uniform(0, 400, (20, 2)), np.ones(20))
    assert np.isfinite(estimate.world_from_camera).all()
    assert np.isfinite(estimate.covariance).all()


@pytest.mark.parametrize("weakest", [1e5, 1.0, 1e-3, 1e-8, 1e-12, 0.0])
def test_the_covariance_is_the_inverse_or_a_huge_variance_where_nothing_measures(weakest):
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(6, 6)))
    measured = np.array([1e7, 1e6, 1e5, 1e4, 1e3, weakest])
    estimate = PoseEstimate(np.eye(4), np.ones(8, bool), (turn * measured) @ turn.T)
    expected = (turn / np.maximum(measured, 1e-9)) @ turn.T
    np.testing.assert_allclose(estimate.covariance, estimate.covariance.T, rtol=1e-6)
    if weakest >= 1e-3:
        np.testing.assert_allclose(estimate.covariance, expected, rtol=1e-5, atol=1e-12)
    else:  # of rounding's size: at least it is said to be huge
        assert np.linalg.eigvalsh(estimate.covariance).max() > 1e6


def strip(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) at the image's left edge, all but one as far away as the next, and their pixels."""
    depth = rng.uniform(2.0, 2.1, count)
    local = np.column_stack([rng.uniform((-0.6, -0.45), (-0.5, 0.45), (count, 2)) * depth[:, None], depth])
    return transform(TRUE, local), CAMERA.project(local)


def test_a_prediction_is_weighed_against_the_points_by_what_both_know():
    """A strip of points leaves some directions to the prediction; together they come to the weighted mean."""
    rng = np.random.default_rng(7)
    points, pixels = strip(rng, 30)
    pixels = pixels + rng.normal(0, 0.3, pixels.shape)
    alone = refine_pose(CAMERA, TRUE, points, pixels, np.ones(30), rounds=1, iterations=20)
    off = np.array([4e-3, -3e-3, 2e-3, 2e-3, -1e-3, 1e-3])
    prediction = Prediction(TRUE @ se3_exp(off), np.diag([4e4, 4e4, 4e4, 1e5, 1e5, 1e5]))
    both, from_there = (
        refine_pose(CAMERA, start, points, pixels, np.ones(30), None, None, 1, 20, prediction)
        for start in (TRUE, alone.world_from_camera)
    )
    at = error_of(alone.world_from_camera)
    # Cauchy's weight at the solution, which is near the prediction where the points say little.
    shift = se3_log(inverse(prediction.world_from_camera) @ both.world_from_camera)
    let_go = prediction.information / (1.0 + shift @ prediction.information @ shift / 16.0)
    expected = np.linalg.solve(alone.information + let_go, alone.information @ at + let_go @ off)
    assert np.abs(at - off).max() > 5e-3
    assert error_of(both.world_from_camera) == pytest.approx(expected, abs=3e-4)
    # From where the points alone would have it every step is a worse one for them.
    assert error_of(from_there.world_from_camera) == pytest.approx(expected, abs=3e-4)
    # What it says of its certainty is what the points know.
    assert both.information == pytest.approx(alone.information, rel=0.1, abs=0.02 * alone.information.max())


def test_many_points_know_better_than_any_prediction():
    rng = np.random.default_rng(8)
    points, pixels = scene(rng, 300)
    pixels = pixels + rng.normal(0, 0.5, pixels.shape)
    alone = refine_pose(CAMERA, TRUE, points, pixels, np.ones(300))
    far = Prediction(TRUE @ se3_exp(np.array([0.3, 0, 0.1, 0, 0.1, 0])), np.eye(6) * 1e6)
    with_it = refine_pose(CAMERA, TRUE, points, pixels, np.ones(300), prediction=far)
    moved = inverse(alone.world_from_camera) @ with_it.world_from_camera
    assert np.abs(se3_log(moved)).max() < 2e-4
    assert np.array_equal(with_it.inliers, alone.inliers)
