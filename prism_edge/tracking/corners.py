"""Which keypoints are corners, and not points of a straight edge.

FAST takes points of an edge for corners where its pixels are uneven. They slide along it from frame to frame,
all to the same side, so no robust kernel minds: of those at a tiled wall two in three are of that kind, and
turned the camera by a degree a frame.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array
from prism_edge.tracking.point_table import Index

SAMPLES, STEP = 5, 1.5  # a side; pixels of the keypoint's own level: its window is 7 x 7
MARGIN = 4  # of those pixels: what a keypoint must be away from the border
FLATTEST = 0.04  # Harris' k: one eigenvalue of the structure tensor is a twentieth of the other


def are_corners(
    grey: NDArray[np.uint8], pixels: NDArray[np.float32], octaves: Index, factors: Array
) -> NDArray[np.bool_]:
    """Whether the image changes both ways about keypoints (n, 2), by Harris' measure (1988).

    ``factors`` has each octave's scale; keypoints are at least MARGIN pixels of their octave inside.
    """
    along_x, along_y = cv2.spatialGradient(grey)
    width = grey.shape[1]
    nearest = np.rint(pixels).astype(np.intp)
    # Keypoints side by side, their windows' pixels one below the other: sums of long rows are faster.
    at = _window(width, tuple(factors)).take(octaves, axis=1)
    at += nearest[:, 1] * width + nearest[:, 0]
    gx, gy = along_x.ravel().take(at).astype(np.float32), along_y.ravel().take(at).astype(np.float32)
    xx, yy, xy = (gx * gx).sum(axis=0), (gy * gy).sum(axis=0), (gx * gy).sum(axis=0)
    corners: NDArray[np.bool_] = xx * yy - xy * xy > FLATTEST * (xx + yy) ** 2
    return corners


@lru_cache(maxsize=8)
def _window(width: int, factors: tuple[float, ...]) -> Index:
    """Offsets (SAMPLES^2, octaves) of a window's pixels in an image's memory."""
    steps = STEP * (np.arange(SAMPLES) - (SAMPLES - 1) / 2)
    offsets = np.rint(np.outer(factors, steps)).astype(np.intp)
    grid: Index = offsets[:, :, None] * width + offsets[:, None, :]
    return np.ascontiguousarray(grid.reshape(len(factors), -1).T)
