"""What never moves in a moving camera's images, found in images whose moving and fixed parts are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from prism_edge.sources.own_parts import APART_NS, OwnParts
from prism_edge.sources.own_parts_watch import IMAGES, OwnPartsWatch
from tests.synthetic.scene import block_texture

SIZE = (480, 640)
WORLD = block_texture(np.random.default_rng(0), 2000, 1500)
BONNET = block_texture(np.random.default_rng(1), 640, 96)


def view(index: int, own: str = "") -> np.ndarray:
    """Image ``index`` of a camera that sways before a wall; ``own``: what of the robot is in it."""
    x, y = round(600 + 500 * np.sin(0.9 * index)), round(450 + 300 * np.sin(0.7 * index))
    image = WORLD[y : y + SIZE[0], x : x + SIZE[1]].copy()
    if own == "bonnet":
        image[-96:] = BONNET
    elif own == "writing":
        cv2.putText(image, "CAMERA 1", (10, 40), cv2.FONT_HERSHEY_SIMPLEX, 1.2, 255, 3)
    elif own == "dirt":  # on the lens, so without outline: it darkens what is behind it
        rows, columns = np.ogrid[: SIZE[0], : SIZE[1]]
        spot = np.exp(-((rows - 200) ** 2 + (columns - 300) ** 2) / (2 * 40.0**2))
        image = (image * (1.0 - 0.5 * spot)).astype(np.uint8)
    noise = np.random.default_rng(index).normal(0.0, 2.0, SIZE)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def after(images: int, own: str = "", gain: float = 0.0) -> OwnParts:
    parts = OwnParts()
    for i in range(images):
        bright = np.exp(gain * np.sin(i))
        assert parts.look(np.clip(bright * view(i, own), 0, 255).astype(np.uint8), i * APART_NS)
    return parts


def full(parts: OwnParts) -> np.ndarray:
    return cv2.resize(parts.found().astype(np.uint8), SIZE[::-1], interpolation=cv2.INTER_NEAREST) > 0


@pytest.mark.parametrize("gain", [0.0, 0.3])
def test_a_bonnet_is_found_whatever_the_light_and_nothing_else(gain: float) -> None:
    own = full(after(30, "bonnet", gain))
    assert own[-90:].mean() > 0.98
    assert not own[:-110].any()


def test_writing_is_found() -> None:
    own = full(after(30, "writing"))
    written = np.zeros(SIZE, np.uint8)
    cv2.putText(written, "CAMERA 1", (10, 40), cv2.FONT_HERSHEY_SIMPLEX, 1.2, 255, 3)
    assert own[written > 0].mean() > 0.98
    assert not own[90:].any()
    assert not own[:, 320:].any()


@pytest.mark.parametrize("own", ["", "dirt"])
def test_a_world_that_moves_throughout_has_none(own: str) -> None:
    assert not full(after(30, own)).any()


def test_a_camera_that_stands_tells_nothing() -> None:
    parts = OwnParts()
    assert parts.look(view(0), 0)
    for i in range(1, 30):
        noisy = np.clip(view(0) + np.random.default_rng(i).normal(0.0, 3.0, SIZE), 0, 255).astype(np.uint8)
        assert not parts.look(noisy, i * APART_NS)
    assert parts.taken == 1
    assert not parts.found().any()


def test_two_images_are_enough_to_find_some() -> None:
    assert not after(1, "bonnet").found().any()
    assert full(after(2, "bonnet"))[-80:].mean() > 0.9


def test_where_nearly_all_stays_it_is_the_camera_that_stood() -> None:
    parts = OwnParts()
    for i in range(30):
        image = view(0)
        image[:160] = view(i)[:160]  # somebody walks by, in a third of the image
        parts.look(image, i * APART_NS)
    assert parts.taken > 20
    assert not parts.found().any()
    assert parts.undecided


def test_images_soon_after_each_other_are_passed_over_and_stamps_may_go_back() -> None:
    parts = OwnParts()
    assert parts.look(view(0), 10 * APART_NS)
    assert not parts.look(view(1), 11 * APART_NS - 1)
    assert parts.look(view(1), 11 * APART_NS)
    assert parts.look(view(2), 0)  # a recording that begins again


def test_images_of_another_size_begin_anew() -> None:
    parts = after(5)
    assert parts.look(view(5)[:240], 5 * APART_NS)
    assert parts.taken == 1
    assert parts.found().shape == (120, 320)


def test_small_and_coloured_images_are_taken_as_they_are() -> None:
    parts = OwnParts()
    for i in range(20):
        small = cv2.resize(view(i, "bonnet"), (160, 120), interpolation=cv2.INTER_AREA)
        assert parts.look(cv2.cvtColor(small, cv2.COLOR_GRAY2BGR), i * APART_NS)
    own = parts.found()
    assert own.shape == (120, 160)
    assert own[-18:].mean() > 0.95
    assert not own[:-34].any()


def watched(own: str, shown: np.ndarray | None = None) -> OwnPartsWatch:
    watch = OwnPartsWatch(shown)
    for i in range(IMAGES):
        assert watch.warning == ""
        watch.look(view(i, own), i * APART_NS)
    return watch


def test_the_watch_says_how_much_stays_until_it_moves() -> None:
    watch = watched("bonnet")
    share = float(watch.warning.split()[0])
    assert share == pytest.approx(20.0, abs=3.0)
    assert "source.mask" in watch.warning
    for i in range(IMAGES, 2 * IMAGES):
        watch.look(view(i), i * APART_NS)
    assert watch.warning == ""


def test_the_watch_has_nothing_to_say_of_what_is_masked_or_moves() -> None:
    shown = np.ones(SIZE, bool)
    shown[-110:] = False
    assert watched("bonnet", shown).warning == ""
    assert watched("").warning == ""
