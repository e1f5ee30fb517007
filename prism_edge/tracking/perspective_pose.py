"""Where a camera is by points whose places are known, without an idea of it before."""

from __future__ import annotations

import cv2
import numpy as np

from prism_edge.geometry.poses import Array, from_rt, inverse

TRIES = 200  # of RANSAC


def perspective_pose(
    positions: Array, pixels: Array, calibration: Array, within_px: float, confidence: float, least: int
) -> Array | None:
    """world_from_camera (4, 4) by perspective-n-point RANSAC; None where fewer than ``least`` points agree.

    ``positions`` (n, 3) in the world and ``pixels`` (n, 2) without distortion, of a camera matrix (3, 3).
    Draws from OpenCV's random numbers: who wants the same answer again seeds them.
    """
    try:
        found, rotation, translation, inliers = cv2.solvePnPRansac(
            positions,
            pixels,
            calibration,
            None,
            iterationsCount=TRIES,
            reprojectionError=within_px,
            confidence=confidence,
            flags=cv2.SOLVEPNP_AP3P,  # draws of four: most of them wrong, 200 still hold a right one
        )
    except cv2.error:
        return None  # degenerate points: all on one spot, say
    if not found or inliers is None or len(inliers) < least:
        return None
    pose = from_rt(cv2.Rodrigues(rotation)[0], translation.ravel())
    return inverse(pose) if np.isfinite(pose).all() else None
