"""Pictures told from others by their corners."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.global_map import no_features
from prism_edge.config import TrackingConfig
from prism_edge.reconstruction import same_picture
from prism_edge.tracking.features import Features, OrbExtractor
from tests.synthetic.render import Renderer
from tests.synthetic.scene import furnished_room, hand_held_path
from tests.synthetic.sequence import synthetic_camera

CAMERA = synthetic_camera(320, 240)


def drawn(frame: int, seed: int = 3) -> np.ndarray:
    return Renderer(furnished_room(seed), CAMERA).draw(hand_held_path(120, 30.0)[frame])[0]


def corners(luma: np.ndarray, **changes: int) -> Features:
    return OrbExtractor(TrackingConfig(**changes)).extract(luma, CAMERA)


def noisy(luma: np.ndarray) -> np.ndarray:
    grain = np.random.default_rng(0).normal(0.0, 2.0, luma.shape)
    return np.clip(np.rint(luma + grain), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("frame", [0, 40, 100])
def test_a_picture_is_its_own_with_noise_and_other_numbers_of_corners(frame: int) -> None:
    luma = drawn(frame)
    assert is_picture_of(corners(noisy(luma)), corners(luma))
    assert is_picture_of(corners(luma, features=300, max_features=300), corners(luma))
    assert is_picture_of(corners(luma), corners(luma, features=500, max_features=500))


def is_picture_of(picture: Features, keyframe: Features) -> bool:
    return same_picture.is_picture_of(picture, keyframe, CAMERA.height)


def part(of: Features, rows: np.ndarray) -> Features:
    chosen = of.pixels[rows], of.octaves[rows], of.descriptors[rows]
    return Features.build(*chosen, CAMERA.width, CAMERA.height)


@pytest.mark.parametrize("frame", [0, 40, 100])
def test_a_keyframe_may_have_a_few_of_the_corners_that_are_found_now(frame: int) -> None:
    """Of a run that kept few, or saw a quarter of the image alone."""
    luma = drawn(frame)
    now, few = corners(noisy(luma)), corners(luma, features=120, max_features=120)
    assert len(few) < 0.25 * len(now)
    assert is_picture_of(now, few)
    whole = corners(luma)
    quarter = part(whole, np.flatnonzero((whole.pixels < (160, 120)).all(axis=1)))
    assert is_picture_of(now, quarter)
    for other in (drawn(frame, seed=4), drawn((frame + 60) % 120)):
        assert not is_picture_of(corners(other), few)
        assert not is_picture_of(corners(other), quarter)


@pytest.mark.parametrize("frame", [0, 40, 100])
def test_a_keyframe_s_corners_may_have_been_moved_for_a_rolling_shutter(frame: int) -> None:
    """A readout of 33 ms in a turn of 60 degrees a second: 13 pixels at the first row and the last."""
    luma = drawn(frame)
    kept = corners(luma)
    kept.pixels[:, 0] += 13.0 * (kept.pixels[:, 1] / 119.5 - 1.0)
    assert is_picture_of(corners(noisy(luma)), kept)
    assert not is_picture_of(corners(drawn(frame, seed=4)), kept)


@pytest.mark.parametrize("aside", [5, 8])
@pytest.mark.parametrize("blank", [slice(0, 0), slice(0, 120), slice(120, 240)])
def test_a_view_moved_aside_is_another_wherever_its_corners_are(aside: int, blank: slice) -> None:
    """Of the lower half alone, what is moved sideways looks as if it were sheared."""
    luma = drawn(40).copy()
    luma[blank] = 128
    assert not is_picture_of(corners(np.roll(luma, aside, axis=1)), corners(luma))


@pytest.mark.parametrize("frame", [0, 40, 100])
def test_another_is_not(frame: int) -> None:
    mine = corners(drawn(frame))
    assert not is_picture_of(corners(drawn(frame, seed=4)), mine)
    assert not is_picture_of(corners(drawn((frame + 60) % 120)), mine)
    assert not is_picture_of(corners(np.ascontiguousarray(drawn(frame)[::-1, ::-1])), mine)


def test_nothing_can_be_told_of_the_dark() -> None:
    assert is_picture_of(corners(np.zeros((240, 320), np.uint8)), corners(drawn(0)))
    assert is_picture_of(corners(drawn(0)), no_features())


def features(pixels: np.ndarray, words: np.ndarray) -> Features:
    return Features.build(pixels, np.zeros(len(pixels), np.intp), words, 640, 480)


def test_a_corner_of_the_keyframe_counts_once_however_many_look_like_it() -> None:
    """A poster's ten corners, found ten times each on as many levels: the other ninety are not there."""
    rng = np.random.default_rng(0)
    at = rng.uniform((20, 20), (620, 460), (100, 2))
    words = rng.integers(0, 2**63, (100, 4)).astype(np.uint64)
    keyframe = features(at, words)
    again = np.repeat(np.arange(10), 10)
    picture = features(at[again] + rng.uniform(-1.0, 1.0, (100, 2)), words[again])
    assert not is_picture_of(picture, keyframe)
    assert not is_picture_of(keyframe, picture)
    assert is_picture_of(keyframe, features(at, words))
