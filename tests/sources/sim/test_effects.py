"""The sensor: each fault alone does what it says, and is gone where it is switched off."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, from_rt, so3_exp
from prism_edge.messages import U8
from prism_edge.sources.sim.effects import EXPOSURE_S, NOISE_SIGMA, Sensor
from prism_edge.sources.sim.source import SimSource

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)


class Turning:
    """Turns about the camera's y axis: the picture moves along x."""

    def __init__(self, rate: float) -> None:
        self.rate = rate

    def pose(self, seconds: float) -> Array:
        return from_rt(so3_exp(np.array([0.0, self.rate * seconds, 0.0])), np.zeros(3))


def picture() -> U8:
    rng = np.random.default_rng(0)
    grey = cv2.GaussianBlur(rng.uniform(0, 255, (240, 320)).astype(np.float32), (0, 0), 2.0)
    grey = 128 + (grey - grey.mean()) * 40 / grey.std()
    return cv2.cvtColor(np.clip(grey, 30, 220).astype(np.uint8), cv2.COLOR_GRAY2BGRA)


def taken(
    noise: float = 0.0, blur: float = 0.0, exposure: float = 0.0, rate: float = 0.0, index: int = 0
) -> U8:
    sensor = Sensor(CAMERA, Turning(rate), 3, noise, blur, exposure)
    return sensor.take(picture(), index, sensor.exposure(index / 30), 2.0)


def test_all_off_changes_nothing() -> None:
    assert np.array_equal(taken(rate=1.0), picture()[:, :, :3])


def test_noise_is_as_strong_as_said_and_new_in_each_frame() -> None:
    first = taken(noise=1.0).astype(float) - picture()[:, :, :3]
    other = taken(noise=1.0, index=1).astype(float) - picture()[:, :, :3]
    assert first.std() == pytest.approx(NOISE_SIGMA, rel=0.06)
    assert abs(first.mean()) < 0.05
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.05
    assert np.array_equal(taken(noise=1.0), taken(noise=1.0))
    strong = taken(noise=2.0).astype(float) - picture()[:, :, :3]
    assert strong.std() == pytest.approx(2 * NOISE_SIGMA, rel=0.06)


def test_exposure_scales_brightness_smoothly() -> None:
    before = picture()[:, :, :3].mean()
    gains = np.array([taken(exposure=1.0, index=k).mean() / before for k in range(0, 900, 3)])
    assert 0.7 < gains.min() < 0.95
    assert 1.05 < gains.max() < 1.42
    assert np.abs(np.diff(gains)).max() < 0.1


@pytest.mark.parametrize("pixels", [1.4, 3.0, 8.0, 12.0])
def test_motion_smears_along_the_motion_as_far_as_it_goes(pixels: float) -> None:
    rate = pixels / (EXPOSURE_S * 262.5)
    out = taken(blur=1.0, rate=rate)[:, :, 0].astype(float)
    clean = picture()[:, :, 0].astype(float)
    middle = np.s_[60:180, 100:220]

    def energy(image: Array, axis: int) -> float:
        return float(np.square(np.diff(image, axis=axis)[middle]).mean())

    # against the mean of copies shifted over that many pixels, as the integral of the exposure is
    columns, rows = np.meshgrid(np.arange(320, dtype=np.float32), np.arange(240, dtype=np.float32))
    shifts = np.linspace(-0.5, 0.5, 41, dtype=np.float32) * pixels
    copies = [cv2.remap(clean.astype(np.float32), columns + s, rows, cv2.INTER_CUBIC) for s in shifts]
    integral = np.mean(copies, axis=0)
    for axis in (0, 1):
        expected = energy(integral, axis) / energy(clean, axis)
        assert energy(out, axis) / energy(clean, axis) == pytest.approx(expected, abs=0.12)


def test_slow_motion_does_not_smear() -> None:
    assert np.array_equal(taken(blur=1.0, rate=0.1), picture()[:, :, :3])


class Sliding:
    """Goes along the camera's x axis: the picture of a wall moves the other way."""

    def __init__(self, speed: float) -> None:
        self.speed = speed

    def pose(self, seconds: float) -> Array:
        return from_rt(np.eye(3), np.array([self.speed * seconds, 0.0, 0.0]))


@pytest.mark.parametrize(("speed", "positions"), [(0.1, 2), (0.3, 4), (1.0, 8)])
def test_a_smear_lies_about_where_the_middle_of_the_exposure_has_it(speed: float, positions: int) -> None:
    bar = np.zeros((240, 320, 4), np.uint8)
    bar[:, 150:170] = 200
    sensor = Sensor(CAMERA, Sliding(speed), 3, 0.0, 10.0, 0.0)
    exposure = sensor.exposure(1.5)
    assert exposure.positions == positions
    out = sensor.take(bar, 0, exposure, 2.0)[120, :, 0].astype(float)
    assert out @ np.arange(320) / out.sum() == pytest.approx(159.5, abs=0.05)


def test_what_is_near_smears_about_its_true_place() -> None:
    """Drawn at the beginning and moved to the middle as what is farther, it lay 0.7 pixels off."""
    walk, pictures = "sim:room?seed=2&speed=1.5&width=320&height=240&noise=0&exposure=0", []
    for blur in (4, 0):
        with SimSource(f"{walk}&blur={blur}") as source:
            pixels = source.image(30).pixels[:, :, 1].astype(np.float32)
            pictures.append(cv2.GaussianBlur(pixels, (0, 0), 3.0))
            depth = source.depth(30)
    smeared, sharp = pictures
    near = cv2.erode((depth < 0.6 * np.median(depth)).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert near.sum() > 1000
    slopes = [cv2.Sobel(sharp, cv2.CV_32F, *axis, scale=0.125)[near] for axis in ((1, 0), (0, 1))]
    shift = np.linalg.lstsq(np.stack(slopes, axis=1), (sharp - smeared)[near], rcond=None)[0]
    assert np.linalg.norm(shift) < 0.1
