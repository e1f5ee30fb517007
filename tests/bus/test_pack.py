"""Images into messages and out again."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sources.tiny_datasets import picture

from prism_edge.bus.pack import FrameLike, grey, pack, rgb


def framed(pixels: np.ndarray) -> FrameLike:
    image, colour = pack(pixels)
    camera = np.array([pixels.shape[1], pixels.shape[0], 60.0, 60.0, 31.5, 23.5])
    return SimpleNamespace(image=image, colour=colour, camera=camera)  # type: ignore[return-value]


sizes = st.tuples(st.integers(2, 40), st.integers(2, 40))


@settings(max_examples=40, deadline=None)
@given(sizes)
def test_grey_of_any_size_loses_nothing(size: tuple[int, int]) -> None:
    pixels = picture(1, *size, colour=False)
    frame = framed(pixels)
    assert not frame.colour
    np.testing.assert_array_equal(grey(frame), pixels)
    np.testing.assert_array_equal(rgb(frame), np.dstack([pixels] * 3))


@settings(max_examples=40, deadline=None)
@given(sizes)
def test_colour_of_any_size_has_the_layout_of_the_message(size: tuple[int, int]) -> None:
    width, height = size
    frame = framed(picture(2, width, height))
    even_width, even_height = width + width % 2, height + height % 2
    assert frame.colour
    assert frame.image.dtype == np.uint8
    assert frame.image.shape == (3 * even_height // 2, even_width)
    assert grey(frame).shape == (height, width)
    assert rgb(frame).shape == (height, width, 3)


def test_luma_is_that_of_bt601() -> None:
    pixels = picture(3)
    b, g, r = np.moveaxis(pixels.astype(np.float64), 2, 0)
    luma = 16 + 0.257 * r + 0.504 * g + 0.098 * b
    assert np.abs(grey(framed(pixels)) - luma).max() <= 1.5


def test_grey_is_a_view() -> None:
    frame = framed(picture(4))
    assert np.shares_memory(grey(frame), frame.image)


@pytest.mark.parametrize(("width", "height"), [(320, 240), (319, 239)])
def test_smooth_colours_come_back(width: int, height: int) -> None:
    pixels = picture(5, width, height)
    frame = framed(pixels)
    off = np.abs(rgb(frame)[:, :, ::-1].astype(int) - pixels)
    assert off.max() <= 20
    assert off.mean() <= 2.0


def test_padding_repeats_the_edge() -> None:
    pixels = picture(6, 63, 47)
    frame = framed(pixels)
    np.testing.assert_array_equal(frame.image[:48, 63], frame.image[:48, 62])
    np.testing.assert_array_equal(frame.image[47, :63], frame.image[46, :63])
