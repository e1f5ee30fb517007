"""A camera that still delivers but no longer sees is found out, and one that sees is left alone."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from prism_edge.sources.live.damage import WAITING
from prism_edge.sources.live.picture_watch import PictureWatch

MS = 1_000_000


def watched(picture: Callable[[int], np.ndarray], seconds: float, watch: PictureWatch | None = None) -> str:
    watch = watch or PictureWatch()
    for k in range(round(30 * seconds)):
        watch.look(picture(k), 10**12 + k * 33 * MS)
    return watch.problem


def scene(seed: int = 0) -> np.ndarray:
    blocks = np.random.default_rng(seed).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    return cv2.resize(blocks, (160, 120), interpolation=cv2.INTER_CUBIC)


def noise(mean: float, sigma: float) -> Callable[[int], np.ndarray]:
    def picture(k: int) -> np.ndarray:
        values = np.random.default_rng(k).normal(mean, sigma, (120, 160, 3))
        return values.clip(0, 255).astype(np.uint8)

    return picture


def test_a_covered_lens() -> None:
    assert "black" in watched(noise(3, 1), 2.0)
    assert "black" in watched(lambda k: np.zeros((48, 64), np.uint8), 2.0)


def test_a_dark_moment_is_not_worth_a_line() -> None:
    assert watched(noise(3, 1), 0.5) == ""


def test_no_picture_at_all_is_one_colour() -> None:
    # What YUV zeros decode to.
    assert "single colour" in watched(lambda k: np.full((120, 160, 3), (0, 135, 0), np.uint8), 2.0)


def test_a_frozen_camera() -> None:
    assert watched(lambda k: scene(), 4.5) == ""
    assert "frozen" in watched(lambda k: scene(), 6.0)


def test_a_still_scene_has_noise() -> None:
    def picture(k: int) -> np.ndarray:
        rng = np.random.default_rng(k)
        return cv2.add(scene(), rng.integers(0, 3, (120, 160, 3), dtype=np.uint8))

    assert watched(picture, 8.0) == ""


def test_a_dim_wall_is_still_a_picture() -> None:
    ramp = np.tile(np.linspace(20, 60, 160).astype(np.uint8), (120, 1))
    shifts = [np.roll(ramp, k, axis=1) for k in range(7)]
    assert watched(lambda k: shifts[k % 7], 8.0) == ""


def test_what_is_over_is_no_longer_said() -> None:
    watch = PictureWatch()
    watched(noise(3, 1), 2.0, watch)
    watch.look(scene(), 2 * 10**12)
    assert watch.problem == ""


def test_damaged_images() -> None:
    watch = PictureWatch()
    for k in range(50):
        watch.look(np.roll(scene(), k, axis=1), 10**12 + k * 33 * MS)
        if k % 25 == 0:
            watch.useless("is damaged")
    assert watch.problem == ""
    for _ in range(5):
        watch.useless("is damaged")
    assert "damaged images" in watch.problem


def test_a_stream_joined_between_two_key_frames_is_not_called_damaged() -> None:
    watch = PictureWatch()
    for _ in range(5):
        watch.useless(WAITING)
    assert "damaged" not in watch.problem
    assert watch.problem.endswith(f"5 of the last 5; each {WAITING}")
    watch.useless("is damaged")
    assert "damaged images, 6 of the last 6" in watch.problem
