"""Depth as a tint: what lets a network of three operators read metres from a generated image.

With y, cb, cr of BT.601 (full range), cb - 128 = -(cr - 128) = CHROMA * s, where s in [-1, 1] is log depth
between NEAREST and FARTHEST. Luma stays the texture's.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

NEAREST, FARTHEST = 0.25, 8.0  # m
CHROMA = 40.0
_MIDDLE = 0.5 * (np.log(NEAREST) + np.log(FARTHEST))
_HALF = 0.5 * (np.log(FARTHEST) - np.log(NEAREST))
_BGR_FROM_LUMA_AND_TINT = np.array([[1.0, 1.772], [1.0, 0.714136 - 0.344136], [1.0, -1.402]], np.float32)


def tinted(luma: NDArray[np.uint8], depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """BGR image (h, w, 3) of luma (h, w) and depth (h, w) in metres, clipped to what the tint can say."""
    s = cv2.log(np.clip(depth, NEAREST, FARTHEST)) * np.float32(CHROMA / _HALF)
    s -= np.float32(_MIDDLE * CHROMA / _HALF)
    colours = cv2.transform(cv2.merge([luma.astype(np.float32), s]), _BGR_FROM_LUMA_AND_TINT)
    return cv2.convertScaleAbs(colours)  # rounds and saturates; no colour in use is below zero


def log_depth_weights() -> tuple[NDArray[np.float32], float]:
    """Weights (3,) of R, G, B in 0..1, and an offset: their sum is log depth in metres."""
    # s CHROMA / 255 = (cb - cr) / 2 with cb = 0.564 (b - y), cr = 0.713 (r - y)
    luma = np.array([0.299, 0.587, 0.114])
    cb = (np.array([0.0, 0.0, 1.0]) - luma) / 1.772
    cr = (np.array([1.0, 0.0, 0.0]) - luma) / 1.402
    return ((cb - cr) / 2.0 * 255.0 * _HALF / CHROMA).astype(np.float32), float(_MIDDLE)
