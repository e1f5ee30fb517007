"""From the pixel formats of cameras to grey or BGR images (pure)."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from prism_edge.messages import U8
from prism_edge.sources.image_file import decode

# Preferred in this order: what isn't compressed first, colour before grey.
FORMATS = ("YUYV", "NV12", "YU12", "UYVY", "BGR3", "RGB3", "MJPG", "JPEG", "GREY")
_COMPRESSED = ("MJPG", "JPEG")
# Bytes a pixel of the first plane, rows in all as a multiple of the height, and what OpenCV makes of it.
_LAYOUTS: dict[str, tuple[int, float, Callable[[U8], U8]]] = {
    "YUYV": (2, 1.0, lambda a: cv2.cvtColor(a, cv2.COLOR_YUV2BGR_YUYV)),
    "UYVY": (2, 1.0, lambda a: cv2.cvtColor(a, cv2.COLOR_YUV2BGR_UYVY)),
    "NV12": (1, 1.5, lambda a: cv2.cvtColor(a, cv2.COLOR_YUV2BGR_NV12)),
    "YU12": (1, 1.5, lambda a: cv2.cvtColor(a, cv2.COLOR_YUV2BGR_I420)),
    "BGR3": (3, 1.0, np.ascontiguousarray),
    "RGB3": (3, 1.0, lambda a: cv2.cvtColor(a, cv2.COLOR_RGB2BGR)),
    "GREY": (1, 1.0, np.ascontiguousarray),
}
# Pixels that share a colour, across and down.
_SHARED = {"YUYV": (2, 1), "UYVY": (2, 1), "NV12": (2, 2), "YU12": (2, 2)}


def can_hold(name: str, width: int, height: int) -> bool:
    """Whether a format has images of that size: where neighbours share a colour only even ones."""
    across, down = _SHARED.get(name, (1, 1))
    return width % across == 0 and height % down == 0


def to_image(data: bytes, name: str, width: int, height: int, stride: int) -> U8 | str:
    """Grey (h, w) or BGR (h, w, 3) image of a buffer, or why there is none.

    ``stride`` is the first plane's bytes a row, 0 where rows follow each other without a gap.
    """
    if name in _COMPRESSED:
        return decode(data)
    depth, planes, convert = _LAYOUTS[name]
    rows, stride = round(height * planes), max(stride, width * depth)
    if len(data) < rows * stride:
        return f"is cut short: {len(data)} of {rows * stride} bytes"
    if name == "YU12" and stride > width:
        return _padded_planes(data, width, height, stride)
    lines = np.frombuffer(data, np.uint8, rows * stride).reshape(rows, stride)[:, : width * depth]
    pixels = np.ascontiguousarray(lines)
    return convert(pixels.reshape(rows, width, depth) if depth > 1 else pixels)


def _padded_planes(data: bytes, width: int, height: int, stride: int) -> U8:
    """I420 whose chroma rows have half the luma's stride."""
    flat = np.frombuffer(data, np.uint8)
    luma = flat[: height * stride].reshape(height, stride)[:, :width]
    chroma = flat[height * stride : height * stride * 3 // 2].reshape(height, stride // 2)[:, : width // 2]
    packed = np.concatenate([luma.ravel(), chroma.ravel()]).reshape(height * 3 // 2, width)
    return cv2.cvtColor(packed, cv2.COLOR_YUV2BGR_I420)
