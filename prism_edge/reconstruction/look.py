"""A keyframe's picture and its depth, pixel for pixel, as a lens without distortion would have them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array
from prism_edge.reconstruction.viewpoints import Viewpoint
from prism_edge.scale.gate import DepthView

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

_WHOLE = 0.99  # of a pixel must have depth where four are blended


@dataclass(frozen=True)
class Look:
    """``view`` has the depth (h, w) in metres, 0 for none, of every pixel of ``grey`` and ``colours``."""

    view: DepthView
    grey: U8  # (h, w)
    colours: U8  # (h, w, 3) RGB

    def with_depth(self, depth: F32) -> Look:
        """The same, at another depth (h, w)."""
        return replace(self, view=replace(self.view, depth=depth))


def look(
    viewpoint: Viewpoint, rgb: U8, depth: F32, confidence: F32, image_to_depth: Array, width: int
) -> Look:
    """Lay picture (height, width, 3), depth and confidence (h, w) of a keyframe out at ``width`` pixels.

    ``confidence`` is (0, 0) where there is none; ``image_to_depth`` (4,) is of raw pixels. A picture that is
    narrower stays as it is.
    """
    taken = viewpoint.camera
    small = _small(taken, width)
    x, y = np.meshgrid(np.arange(small.width, dtype=np.float64), np.arange(small.height, dtype=np.float64))
    across, down = small.width / taken.width, small.height / taken.height
    ideal = np.column_stack([(x.ravel() + 0.5) / across - 0.5, (y.ravel() + 0.5) / down - 0.5])
    raw = taken.distort_pixels(ideal)
    colours = cv2.resize(rgb, (small.width, small.height), interpolation=cv2.INTER_AREA)
    if not taken.is_ideal:
        colours = _at(colours, (raw + 0.5) * (across, down) - 0.5, small)
    a, b, c, d = image_to_depth
    at = raw * (a, c) + (b, d)
    there = _at((depth > 0).astype(np.float32), at, small)
    metres = _at(np.where(depth > 0, depth, 0.0).astype(np.float32), at, small)
    whole = there > _WHOLE
    view = DepthView(
        viewpoint.keyframe,
        viewpoint.map_from_camera,
        small,
        np.where(whole, metres / np.where(whole, there, 1.0), 0.0).astype(np.float32),
        np.array([1.0, 0.0, 1.0, 0.0]),
        _at(confidence, at, small) if confidence.size else confidence,
        1.0,
    )
    return Look(view, cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY), np.ascontiguousarray(colours))


def _small(taken: Camera, width: int) -> Camera:
    """The ideal camera of a picture of that width."""
    scale = min(1.0, width / taken.width)
    size = max(1, round(taken.width * scale)), max(1, round(taken.height * scale))
    across, down = size[0] / taken.width, size[1] / taken.height
    return Camera(
        *size,
        taken.fx * across,
        taken.fy * down,
        (taken.cx + 0.5) * across - 0.5,
        (taken.cy + 0.5) * down - 0.5,
    )


def _at(plane: NDArray, pixels: Array, camera: Camera) -> NDArray:
    """Values of a plane at pixels (h w, 2) of it, for a picture of ``camera``; 0 outside."""
    shape = (camera.height, camera.width)
    x, y = pixels.astype(np.float32).T
    return cv2.remap(plane, x.reshape(shape), y.reshape(shape), cv2.INTER_LINEAR)
