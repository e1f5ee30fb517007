"""gtsam's factors as they are made here, against formulas and numerical derivatives."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import C, L, X
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.backend.factors import FactorFactory, _axes_along, _direction, held
from prism_edge.backend.global_map import GlobalKeyframe
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import inverse, scaled, se3_exp, transform
from tests.tracking.cloud import CAMERA, pose_at

CONFIG = BackendConfig()
POSE = pose_at(0.4, -0.3, 0.2, 0.1, -0.2, 0.15)
POINT = transform(POSE, np.array([[0.5, -0.4, 2.5]]))[0]


def reprojection(pixel: np.ndarray, octave: int) -> gtsam.NonlinearFactor:
    return FactorFactory(CONFIG, 1.0).reprojection(X(0), L(0), keyframe_of(pixel, octave), 0)


def metric_depth(
    pixel: np.ndarray, depth: float, units_per_metre: float = 1.0, weight: float = 1.0
) -> gtsam.NonlinearFactor:
    factory = FactorFactory(CONFIG, units_per_metre)
    return factory.metric_depth(X(0), L(0), keyframe_of(pixel, 0, depth, weight), 0)


def ray(
    pixel: np.ndarray, current_range: float, units_per_metre: float = 1.0, weight: float = 1.0
) -> gtsam.NonlinearFactor:
    factory = FactorFactory(CONFIG, units_per_metre)
    return factory.ray(X(0), L(0), keyframe_of(pixel, 0, 0.0, weight), 0, current_range)


def keyframe_of(pixel: np.ndarray, octave: int, depth: float = 0.0, weight: float = 1.0) -> GlobalKeyframe:
    sigmas, depths, weights = np.array([1.2**octave]), np.array([depth]), np.array([weight])
    return GlobalKeyframe(0, 0, CAMERA, POSE, pixel[None], sigmas, {0: 0}, depths, weights=weights)


def pluecker_distance(pose: np.ndarray, pixel: np.ndarray, point: np.ndarray) -> float:
    """|d x X + m| / |d| with m = t x d: the paper's equation 6, in the world frame."""
    d = pose[:3, :3] @ np.linalg.inv(CAMERA.matrix) @ (*pixel, 1.0)
    moment = np.cross(pose[:3, 3], d)
    return float(np.linalg.norm(np.cross(d, point) + moment) / np.linalg.norm(d))


def values_of(pose: np.ndarray, point: np.ndarray) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3(pose))
    values.insert(L(0), point)
    return values


def huber(residual: float, k: float) -> float:
    """gtsam's loss of a whitened residual."""
    return 0.5 * residual**2 if residual <= k else k * (residual - 0.5 * k)


@settings(max_examples=40, deadline=None)
@given(st.floats(-30, 30), st.floats(-30, 30), st.integers(0, 7))
def test_reprojection_is_huber_of_the_pixel_error_in_sigmas_of_its_level(dx, dy, octave):
    local = transform(inverse(POSE), POINT[None])
    pixel = CAMERA.project(local)[0] + (dx, dy)
    factor = reprojection(pixel, octave)
    expected = huber(np.hypot(dx, dy) / (CONFIG.pixel_sigma * 1.2**octave), CONFIG.huber_pixels)
    assert factor.error(values_of(POSE, POINT)) == pytest.approx(expected, rel=1e-6, abs=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.3, 3.0), st.floats(0.1, 1.0), st.floats(0.5, 2.0))
def test_metric_depth_is_huber_of_the_range_error(ratio, weight, units_per_metre):
    local = transform(inverse(POSE), POINT[None])
    pixel = CAMERA.project(local)[0]
    measured = ratio * local[0, 2]
    factor = metric_depth(pixel, measured, units_per_metre, weight)
    # range = z |K^-1 p|; sigma is relative to it; the threshold is a length in metres
    ray = np.linalg.inv(CAMERA.matrix) @ (*pixel, 1.0)
    measured_range = measured * np.linalg.norm(ray)
    sigma = CONFIG.depth_sigma * measured_range / np.sqrt(weight)
    residual = abs(np.linalg.norm(local) - measured_range)
    # Sigmas are rounded to steps of a tenth, which the threshold, a length, does not feel.
    error = factor.error(values_of(POSE, POINT))
    least, most = (
        huber(residual / s, CONFIG.huber_depth_m * units_per_metre / s) for s in (1.06 * sigma, sigma / 1.06)
    )
    assert least - 1e-9 <= error <= most + 1e-9


def test_a_sensor_s_depth_is_as_sure_as_the_sensor_has_it():
    """Not as a network would be: ten times as sure costs a hundred times as much."""
    pixel = CAMERA.project(transform(inverse(POSE), POINT[None]))[0]
    keyframe = keyframe_of(pixel, 0, 2.5 * 1.001)
    costs = []
    for sigma in (CONFIG.depth_sigma / 10.0, 0.0):  # 0: the source doesn't say
        keyframe.depth_sigma = sigma
        factor = FactorFactory(CONFIG, 1.0).metric_depth(X(0), L(0), keyframe, 0)
        costs.append(factor.error(values_of(POSE, POINT)))
    assert costs[0] / costs[1] == pytest.approx(100.0, rel=0.25)  # both sigmas are rounded


@pytest.mark.parametrize(("k1", "dx", "dy"), [(0.0, 3.0, -2.0), (-0.08, 0.0, 0.0), (0.05, -1.0, 9.0)])
def test_through_a_lens_it_is_huber_of_the_error_of_the_pixel_as_taken(k1, dx, dy):
    """r -> r (1 + k1 r^2), from a camera that has another lens so far, and pixels that are not square."""
    camera = replace(CAMERA, fy=1.1 * CAMERA.fx, distortion=(-0.03, 0.0, 0.0, 0.0))
    local = transform(inverse(POSE), POINT[None])[0]
    ray = local[:2] / local[2]
    true = camera.ideal().to_pixels((ray * (1.0 + k1 * (ray @ ray)))[None])
    keyframe = replace(keyframe_of(camera.undistort_pixels(true + np.array([dx, dy]))[0], 2), camera=camera)
    factory = FactorFactory(CONFIG, 1.0)
    values = values_of(POSE, POINT)
    values.insert(C(0), gtsam.Cal3Bundler(camera.fx, k1, 0.0, 0.0, 0.0))
    expected = huber(np.hypot(dx, dy / 1.1) / (CONFIG.pixel_sigma * 1.2**2), CONFIG.huber_pixels)
    for _ in range(2):  # made once, and remembered
        factor = factory.reprojection_through(C(0), X(0), L(0), keyframe, 0)
        assert factor.error(values) == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_a_weight_of_nothing_leaves_a_finite_factor():
    factor = metric_depth(np.array([100.0, 100.0]), 2.0, weight=0.0)
    assert 0 < factor.error(values_of(POSE, POINT)) < 1e-2


@pytest.mark.parametrize("far", [False, True])
def test_gradients_are_numerical_derivatives(far):
    """Of the robust cost, within the threshold and beyond."""
    local = transform(inverse(POSE), POINT[None])
    pixel = CAMERA.project(local)[0] + ((20.0, -12.0) if far else (0.7, -0.4))
    depth = local[0, 2] * (1.6 if far else 1.01)
    for factor in (reprojection(pixel, 1), metric_depth(pixel, depth, weight=0.7)):
        graph = gtsam.NonlinearFactorGraph()
        graph.add(factor)
        gradient = graph.linearize(values_of(POSE, POINT)).gradientAtZero()
        for axis in range(6):
            # gtsam: rotation first, on the right of the pose
            step = np.zeros(6)
            step[axis] = 1e-6
            twist = np.r_[step[3:], step[:3]]
            ahead, behind = (factor.error(values_of(POSE @ se3_exp(s * twist), POINT)) for s in (1, -1))
            assert gradient.at(X(0))[axis] == pytest.approx((ahead - behind) / 2e-6, rel=1e-4, abs=1e-5)
        for axis in range(3):
            step = 1e-6 * np.eye(3)[axis]
            ahead, behind = (factor.error(values_of(POSE, POINT + s * step)) for s in (1, -1))
            assert gradient.at(L(0))[axis] == pytest.approx((ahead - behind) / 2e-6, rel=1e-4, abs=1e-5)


def test_depth_is_what_fixes_the_scale():
    """Scaling pose and point about the origin leaves a reprojection as it is, and not a range."""
    pose = pose_at(0.4, -0.3, 0.2)
    local = transform(inverse(pose), POINT[None])
    pixel = CAMERA.project(local)[0] + 0.5
    seen, ranged = reprojection(pixel, 0), metric_depth(pixel, local[0, 2])
    bigger = pose.copy()
    bigger[:3, 3] *= 1.2
    assert seen.error(values_of(bigger, 1.2 * POINT)) == pytest.approx(seen.error(values_of(pose, POINT)))
    assert ranged.error(values_of(bigger, 1.2 * POINT)) > 100 * ranged.error(values_of(pose, POINT))


def test_a_held_pose_is_dearer_than_any_measurement():
    factor = held(X(0), POSE)
    assert factor.error(values_of(POSE, POINT)) == pytest.approx(0.0)
    assert factor.error(values_of(POSE @ pose_at(0.001), POINT)) > 1e5


@settings(max_examples=60, deadline=None)
@given(st.floats(-40, 40), st.floats(-40, 40), st.floats(0.1, 1.0), st.floats(0.5, 2.0))
def test_a_ray_is_the_pluecker_distance_to_second_order(dx, dy, weight, units_per_metre):
    """Its own Huber threshold, 0.05 m, the gate's weight and the least of noises, a pixel's, included."""
    local = transform(inverse(POSE), POINT[None])
    pixel = CAMERA.project(local)[0] + (dx, dy)
    distance = pluecker_distance(POSE, pixel, POINT)
    current = float(np.linalg.norm(local))
    least = CONFIG.pixel_sigma / CAMERA.fx * current
    sigma = max(CONFIG.ray_sigma_m * units_per_metre, least) / np.sqrt(weight)
    expected = huber(distance / sigma, CONFIG.huber_ray_m / CONFIG.ray_sigma_m * np.sqrt(weight))
    angle = np.arcsin(distance / current)
    # sin a = a (1 - a^2 / 6); sigmas are rounded to a hundredth, thresholds in sigmas too
    tolerance = angle**2 / 3 + 0.012
    error = ray(pixel, current, units_per_metre, weight).error(values_of(POSE, POINT))
    assert error == pytest.approx(expected, rel=tolerance, abs=1e-9)


def test_a_gross_ray_costs_in_proportion_to_its_distance():
    """Beyond 0.05 m Huber's loss is linear; before, quadratic."""
    local = transform(inverse(POSE), POINT[None])
    current = float(np.linalg.norm(local))
    costs = []
    for metres in (0.01, 0.02, 0.2, 0.4):
        aside = POINT + POSE[:3, 0] * metres
        costs.append(ray(CAMERA.project(local)[0], current).error(values_of(POSE, aside)))
    assert costs[1] / costs[0] == pytest.approx(4.0, rel=0.02)
    assert costs[3] / costs[2] == pytest.approx(2.0, rel=0.15)


@pytest.mark.parametrize("octave", [0, 3])
def test_far_away_a_ray_counts_as_what_it_is_a_pixel(octave):
    """A centimetre at a kilometre would be a hundredth of a pixel."""
    far = transform(POSE, np.array([[50.0, -40.0, 1000.0]]))[0]
    exact = CAMERA.project(transform(inverse(POSE), far[None]))[0]
    pixel = exact + np.array([1.0, 0.0])
    keyframe = keyframe_of(pixel, octave)
    factor = FactorFactory(CONFIG, 1.0).ray(X(0), L(0), keyframe, 0, float(np.linalg.norm(far)))
    assert factor.error(values_of(POSE, far)) == pytest.approx(
        reprojection(pixel, octave).error(values_of(POSE, far)), rel=0.05
    )


def test_rays_alone_say_nothing_of_the_scale():
    """d cost / d log s = 0, where the exact residual, a length, would reward shrinking the map."""
    local = transform(inverse(POSE), POINT[None])
    pixel = CAMERA.project(local)[0] + (3.0, -2.0)
    factor = ray(pixel, float(np.linalg.norm(local)))
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    gradient = graph.linearize(values_of(POSE, POINT)).gradientAtZero()
    # d/d log s moves the point by itself and the camera by its position, in its own frame
    along = np.dot(gradient.at(X(0))[3:], POSE[:3, :3].T @ POSE[:3, 3]) + np.dot(gradient.at(L(0)), POINT)
    assert np.linalg.norm(gradient.at(L(0))) > 1.0, "it does say something"
    assert along == pytest.approx(0.0, abs=1e-8)
    exact = [pluecker_distance(scaled(POSE, s), pixel, s * POINT) for s in (1.0, 0.9)]
    assert exact[1] == pytest.approx(0.9 * exact[0])


def test_a_shut_gate_lets_a_ray_be():
    factor = ray(np.array([100.0, 100.0]), 2.0, weight=0.0)
    assert 0 < factor.error(values_of(POSE, POINT)) < 1.0


def test_metric_depth_high_up_in_the_image_is_along_its_own_ray():
    """There the second focal length counts, which differs from the first."""
    local = np.array([[0.1, -1.1, 2.0]])
    point = transform(POSE, local)[0]
    factor = metric_depth(CAMERA.project(local)[0], 2.0)
    assert factor.error(values_of(POSE, point)) == pytest.approx(0.0, abs=1e-9)


def of_point(factor: gtsam.NonlinearFactor, point: np.ndarray) -> tuple[float, np.ndarray]:
    """A factor's cost at a point, and the gradient of its robust cost there."""
    values, graph = values_of(POSE, point), gtsam.NonlinearFactorGraph()
    graph.add(factor)
    return factor.error(values), graph.linearize(values).gradientAtZero().at(L(0))


@settings(max_examples=40, deadline=None)
@given(st.floats(-30, 30), st.floats(-30, 30), st.integers(0, 7), st.booleans())
def test_from_a_known_pose_a_reprojection_is_the_same_factor_of_the_point_alone(dx, dy, octave, behind):
    point = POINT - 5.0 * POSE[:3, 2] if behind else POINT
    pixel = CAMERA.project(transform(inverse(POSE), POINT[None]))[0] + (dx, dy)
    factor = FactorFactory(CONFIG, 1.0).reprojection_from(L(0), keyframe_of(pixel, octave), 0)
    assert list(factor.keys()) == [L(0)]
    (cost, gradient), (expected, along) = (
        of_point(one, point) for one in (factor, reprojection(pixel, octave))
    )
    assert cost == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert gradient == pytest.approx(along, rel=1e-6, abs=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.floats(-40, 40), st.floats(-40, 40), st.floats(0.1, 1.0), st.floats(0.5, 2.0))
def test_from_a_known_pose_a_ray_is_the_pluecker_distance_to_second_order(dx, dy, weight, units_per_metre):
    local = transform(inverse(POSE), POINT[None])
    pixel, current = CAMERA.project(local)[0] + (dx, dy), float(np.linalg.norm(local))
    factory, keyframe = FactorFactory(CONFIG, units_per_metre), keyframe_of(pixel, 0, 0.0, weight)
    factor = factory.ray_from(L(0), keyframe, 0, current)
    assert list(factor.keys()) == [L(0)]
    (cost, gradient), (expected, along) = (
        of_point(one, POINT) for one in (factor, ray(pixel, current, units_per_metre, weight))
    )
    distance = pluecker_distance(POSE, pixel, POINT)
    sigma = max(CONFIG.ray_sigma_m * units_per_metre, CONFIG.pixel_sigma / CAMERA.fx * current)
    sigma /= np.sqrt(weight)
    exact = huber(distance / sigma, CONFIG.huber_ray_m / CONFIG.ray_sigma_m * np.sqrt(weight))
    angle2 = np.arcsin(distance / current) ** 2
    assert cost == pytest.approx(exact, rel=angle2 + 0.012, abs=1e-9)
    assert cost == pytest.approx(expected, rel=angle2, abs=1e-9)
    slack = 3 * angle2 * np.abs(along).max() + 1e-9
    assert gradient == pytest.approx(along, rel=1e-6, abs=slack)


@pytest.mark.parametrize("pixel", [(0.0, 0.0), (CAMERA.cx, CAMERA.cy), (600.0, 17.0), (-900.0, 2000.0)])
def test_the_camera_of_a_ray_is_a_camera_that_looks_along_it(pixel):
    direction = _direction(keyframe_of(np.array(pixel), 0), 0)
    axes = _axes_along(direction)
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert axes[:, 2] == pytest.approx(direction / np.linalg.norm(direction))


@pytest.mark.parametrize("distance", [0.5, 4.0])
def test_a_pose_is_nearly_held_to_a_pixel_of_what_is_so_far_away(distance: float) -> None:
    """A step aside and a turn that each move such a thing's picture by a pixel cost one sigma each."""
    keyframe = keyframe_of(np.array([300.0, 200.0]), 0)
    factor = FactorFactory(replace(CONFIG, pixel_sigma=2.0), 1.0).nearly_held(X(0), keyframe, distance)
    aside, turn = 2.0 * distance / CAMERA.fx, 2.0 / CAMERA.fx
    for twist in ([aside, 0, 0, 0, 0, 0], [0, 0, 0, 0, turn, 0]):
        moved = POSE @ se3_exp(np.array(twist, float))
        assert factor.error(values_of(moved, POINT)) == pytest.approx(0.5, rel=1e-3)
    assert factor.error(values_of(POSE, POINT)) == pytest.approx(0.0, abs=1e-12)
