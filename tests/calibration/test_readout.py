"""The readout that residuals show, against points projected row by row."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.calibration.readout import BLOCKS, LEAST_POINTS, ReadoutFit
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, inverse, se3_exp, transform

CAMERA = Camera(640, 480, 525.0, 500.0, 310.5, 251.5)


def scene(rng: np.random.Generator, count: int = 120) -> Array:
    depth = rng.uniform(1.0, 5.0, count)
    return np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)) * depth[:, None], depth])


def read_row_by_row(points: Array, twist: Array, readout_s: float) -> Array:
    """Where points (n, 3), as the camera has them in the middle of the readout, are seen (n, 2)."""
    pixels = CAMERA.project(points)
    for _ in range(8 if readout_s else 0):
        at = ((pixels[:, 1] + 0.5) / CAMERA.height - 0.5) * readout_s
        seen = [transform(inverse(se3_exp(twist * t)), p[None]) for t, p in zip(at, points, strict=True)]
        pixels = CAMERA.project(np.concatenate(seen))
    return pixels


def fitted(readout_ms: float, noise_px: float, seed: int, frames: int = 40, speed: float = 0.4) -> ReadoutFit:
    """Frames of a camera that turns and shifts, each a little beside where its pose has it."""
    rng, fit = np.random.default_rng(seed), ReadoutFit()
    for _ in range(frames):
        points, twist = scene(rng), rng.normal(0.0, speed, 6)
        pixels = read_row_by_row(points, twist, 1e-3 * readout_ms)
        pixels += rng.normal(0.0, 1.0, pixels.shape) * noise_px
        off = se3_exp(rng.normal(0.0, 1e-3, 6))
        fit.add(CAMERA, transform(off, points), pixels, pixels[:, 1], np.ones(len(points)), twist)
    return fit


@pytest.mark.parametrize("readout_ms", [26.0, -15.0, 0.0])
def test_it_is_found_beside_errors_of_the_poses(readout_ms: float) -> None:
    left, sigma = fitted(readout_ms, 0.0, seed=1).left_ms
    assert left == pytest.approx(readout_ms, abs=0.3)
    assert sigma < 0.3


def test_its_sigma_is_that_of_its_errors_where_nothing_is_left() -> None:
    found = np.array([fitted(0.0, 1.0, seed).left_ms for seed in range(24)])
    assert 0.6 < np.sqrt(np.mean((found[:, 0] / found[:, 1]) ** 2)) < 1.6


def test_far_from_it_too_little_is_found_but_the_right_way() -> None:
    """What is read late looks like an outlier; who says what was found, and looks again, comes nearer."""
    left, sigma = fitted(20.0, 1.0, seed=1).left_ms
    assert 8.0 * sigma < left < 20.0


def test_some_that_lie_far_off_weigh_little() -> None:
    rng, fit = np.random.default_rng(3), ReadoutFit()
    for _ in range(40):
        points, twist = scene(rng), rng.normal(0.0, 0.4, 6)
        pixels = read_row_by_row(points, twist, 0.02)
        pixels[:6] += 50.0 * np.sign(twist[4])
        fit.add(CAMERA, points, pixels, pixels[:, 1], np.ones(len(points)), twist)
    assert fit.left_ms[0] == pytest.approx(20.0, abs=2.0)


def test_pixels_of_large_sigma_weigh_less() -> None:
    rng, fit = np.random.default_rng(4), ReadoutFit()
    for _ in range(20):
        points, twist = scene(rng), rng.normal(0.0, 0.4, 6)
        pixels = read_row_by_row(points, twist, 0.02)
        pixels[60:] = read_row_by_row(points[60:], twist, 0.0)
        sigmas = np.where(np.arange(120) < 60, 1.0, 20.0)
        fit.add(CAMERA, points, pixels, pixels[:, 1], sigmas, twist)
    assert fit.left_ms[0] == pytest.approx(20.0, abs=0.5)


def test_a_camera_at_rest_and_too_little_say_nothing() -> None:
    assert np.isnan(fitted(20.0, 0.5, seed=2, speed=0.0).left_ms).all()
    assert np.isnan(fitted(20.0, 0.5, seed=2, frames=BLOCKS - 1).left_ms).all()
    fit, points = ReadoutFit(), scene(np.random.default_rng(5), LEAST_POINTS)
    points[0, 2] *= -1.0  # behind it
    fit.add(CAMERA, points, CAMERA.project(points), np.zeros(LEAST_POINTS), np.ones(LEAST_POINTS), np.ones(6))
    assert len(fit) == 0
