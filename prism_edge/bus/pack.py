"""Images as they travel in messages, and back (pure).

Colour travels as I420: full-size luma, which is what the tracker reads as it is, and quarter-size
chroma; half the bytes of BGR. Grey images lose nothing. Colour loses three quarters of its chroma
samples and a rounding of the luma, which spans 16..235; an image that comes from a JPEG or video with
4:2:0 chroma had no more chroma to begin with and loses the rounding alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.messages import F64, U8


class FrameLike(Protocol):
    """What Frame and KeyframeImage have in common here."""

    @property
    def colour(self) -> bool: ...

    @property
    def camera(self) -> F64: ...  # width and height first

    @property
    def image(self) -> U8: ...


@dataclass(frozen=True)
class PackedImage:
    """An image as it travels, beside no message: for whoever needs what the daemon's processes would see."""

    colour: bool
    camera: F64
    image: U8


def pack(pixels: U8) -> tuple[U8, bool]:
    """(``image``, ``colour``) of a Frame from a grey (h, w) or BGR (h, w, 3) image.

    I420 takes even sizes: an odd one grows by a copy of its last row or column.
    """
    if pixels.ndim == 2:
        return np.ascontiguousarray(pixels), False
    height, width = pixels.shape[:2]
    if height % 2 or width % 2:
        pixels = cv2.copyMakeBorder(pixels, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2YUV_I420), True


def as_sent(pixels: U8, camera: Camera) -> PackedImage:
    """What the daemon's processes would be given of a camera's grey or BGR image."""
    image, colour = pack(pixels)
    return PackedImage(colour, camera.to_array(), image)


def grey(frame: FrameLike) -> U8:
    """The luma plane (h, w) of the camera's own size: a view, not a copy."""
    width, height = int(frame.camera[0]), int(frame.camera[1])
    return frame.image[:height, :width]


def rgb(frame: FrameLike) -> U8:
    """The image (h, w, 3) as networks take it."""
    if not frame.colour:
        return cv2.cvtColor(np.ascontiguousarray(grey(frame)), cv2.COLOR_GRAY2RGB)
    width, height = int(frame.camera[0]), int(frame.camera[1])
    return cv2.cvtColor(frame.image, cv2.COLOR_YUV2RGB_I420)[:height, :width]
