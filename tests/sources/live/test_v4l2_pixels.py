"""Pixel formats of cameras, each made from a known picture by its definition."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.sources.live.v4l2_pixels import FORMATS, to_image

W, H = 16, 8


def planes() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Luma (h, w) and chroma of one colour each half: blue left, red right, of ITU-R BT.601."""
    luma = np.full((H, W), 41, np.uint8)
    u, v = np.full((H, W // 2), 240, np.uint8), np.full((H, W // 2), 110, np.uint8)
    luma[:, W // 2 :], u[:, W // 4 :], v[:, W // 4 :] = 82, 90, 240
    return luma, u, v


def padded(rows: np.ndarray, stride: int) -> bytes:
    return np.pad(rows, ((0, 0), (0, stride - rows.shape[1]))).tobytes()


def encoded(name: str, pad: int) -> tuple[bytes, int]:
    luma, u, v = planes()
    if name in ("YUYV", "UYVY"):
        packed = np.empty((H, W, 2), np.uint8)
        at = 0 if name == "YUYV" else 1
        packed[:, :, at] = luma
        packed[:, 0::2, 1 - at], packed[:, 1::2, 1 - at] = u, v
        return padded(packed.reshape(H, 2 * W), 2 * W + pad), 2 * W + pad
    if name == "NV12":
        chroma = np.stack([u[::2], v[::2]], axis=2).reshape(H // 2, W)
        return padded(luma, W + pad) + padded(chroma, W + pad), W + pad
    if name == "YU12":
        half = (W + pad) // 2
        return padded(luma, W + pad) + padded(u[::2], half) + padded(v[::2], half), W + pad
    bgr = np.zeros((H, W, 3), np.uint8)
    bgr[:, : W // 2, 0] = bgr[:, W // 2 :, 2] = 255
    if name == "RGB3":
        bgr = bgr[:, :, ::-1]
    return padded(bgr.reshape(H, 3 * W), 3 * W + pad), 3 * W + pad


@pytest.mark.parametrize("pad", [0, 16])
@pytest.mark.parametrize("name", ["YUYV", "UYVY", "NV12", "YU12", "BGR3", "RGB3"])
def test_colours_arrive(name: str, pad: int) -> None:
    data, stride = encoded(name, pad)
    image = to_image(data + b"\0" * 100, name, W, H, stride)
    assert isinstance(image, np.ndarray)
    assert image.shape == (H, W, 3)
    np.testing.assert_allclose(image[:, :6].mean((0, 1)), [255, 0, 0], atol=8)
    np.testing.assert_allclose(image[:, -6:].mean((0, 1)), [0, 0, 255], atol=8)


def test_grey_stays_grey() -> None:
    luma = np.arange(H * W, dtype=np.uint8).reshape(H, W)
    np.testing.assert_array_equal(to_image(padded(luma, W + 8), "GREY", W, H, W + 8), luma)
    np.testing.assert_array_equal(to_image(luma.tobytes(), "GREY", W, H, 0), luma)


@settings(max_examples=60, deadline=None)
@given(name=st.sampled_from(FORMATS), data=st.binary(max_size=600), stride=st.integers(0, 64))
def test_any_bytes_are_an_image_or_a_reason(name: str, data: bytes, stride: int) -> None:
    image = to_image(data, name, W, H, stride)
    assert isinstance(image, str) or image.shape[:2] == (H, W)
