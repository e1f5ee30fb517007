"""A picture of where corners were seen, and how far each missed (pure)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.calibration.board import View
from prism_edge.calibration.solve import Calibration
from prism_edge.calibration.verdict import COLUMNS, ROWS, covered
from prism_edge.geometry.poses import Array
from prism_edge.messages import U8

_ENLARGED = 20.0  # residuals, against the image
_GOOD, _BAD = (90, 200, 60), (40, 40, 230)  # BGR
_UNKNOWN = (140, 140, 140)
_WORST = 1.0  # pixels, drawn as bad


def draw(
    views: Sequence[View],
    outlines: Sequence[Array],
    width: int,
    height: int,
    result: Calibration | None = None,
) -> U8:
    """BGR image of the camera's size: cells without a corner shaded, outlines of the views that were used,
    a dot for each corner from green (exact) to red (1 pixel off), its residual 20 times enlarged.

    Without a result, all views, and grey dots: how far a corner is off is not known.
    """
    used = tuple(range(len(views))) if result is None else result.used
    missed = [np.zeros_like(views[k].pixels) for k in used] if result is None else result.residuals
    picture = np.full((height, width, 3), 250, np.uint8)
    for (row, column), count in np.ndenumerate(covered(views, width, height)):
        top, left = row * height // ROWS, column * width // COLUMNS
        bottom, right = (row + 1) * height // ROWS, (column + 1) * width // COLUMNS
        if count == 0:
            picture[top:bottom, left:right] = (205, 205, 235)
        cv2.rectangle(picture, (left, top), (right, bottom), (225, 225, 225), 1)
    for k in used:
        cv2.polylines(picture, [_fixed(outlines[k])], True, (225, 205, 185), 1, cv2.LINE_AA, 4)
    radius = max(2, width // 320)
    for k, residuals in zip(used, missed, strict=True):
        for pixel, residual in zip(views[k].pixels, residuals, strict=True):
            share = min(1.0, float(np.hypot(*residual)) / _WORST)
            shade = tuple(int(g + share * (b - g)) for g, b in zip(_GOOD, _BAD, strict=True))
            colour = _UNKNOWN if result is None else shade
            ends = _fixed([pixel, pixel + _ENLARGED * residual])
            cv2.polylines(picture, [ends], False, colour, 1, cv2.LINE_AA, 4)
            cv2.circle(picture, (int(ends[0, 0]), int(ends[0, 1])), radius * 16, colour, -1, cv2.LINE_AA, 4)
    return picture


def _fixed(points: Sequence[Array] | Array) -> NDArray[np.int32]:
    """Whole sixteenths of pixels, as OpenCV draws them; what lies far outside stays within its numbers."""
    return np.clip(np.array(points) * 16, -(2**20), 2**20).round().astype(np.int32)
