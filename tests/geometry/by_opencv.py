"""Undistortion by OpenCV, iterated until it stands: its usual five steps fall short for strong distortion."""

from __future__ import annotations

import cv2
import numpy as np

from prism_edge.geometry.poses import Array

STOP = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12


def undistorted(pixels: Array, matrix: Array, distortion: Array, new_matrix: Array) -> Array:
    """Pixels (n, 2) of a lens as ``new_matrix`` has them without it."""
    given = pixels[:, None].astype(np.float64), matrix, distortion
    if hasattr(cv2, "undistortPointsIter"):  # until OpenCV 5
        found = cv2.undistortPointsIter(*given, np.eye(3), new_matrix, STOP)
    else:
        found = cv2.undistortPoints(*given, R=None, P=new_matrix, criteria=STOP)
    return np.asarray(found)[:, 0]
