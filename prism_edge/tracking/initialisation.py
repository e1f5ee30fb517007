"""Structure from the first two views alone: it frees a map from a network that is at a loss."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, from_rt, inverse
from prism_edge.tracking.triangulation import rays, triangulate

MIN_MATCHES = 60
MIN_POINTS = 50  # triangulated at MIN_PARALLAX
MIN_PARALLAX = np.radians(1.0)
EPIPOLAR_PX = 1.0
REPROJECTION_PX = 2.0
MIN_INLIER_SHARE = 0.6


@dataclass(frozen=True)
class TwoViews:
    """Relative pose and points of two views, in the unit of the depths that were given."""

    first_from_second: Array  # (4, 4)
    points: Array  # (n, 3) in the first camera
    parallax: Array  # (n,) rad
    good: NDArray[np.bool_]  # (n,) before both cameras, and reprojecting into both
    depth_spread: float  # of log(given / triangulated) depth, one sigma (robust)


def reconstruct(
    camera: Camera, first: Array, second: Array, first_depths: Array, seed: int
) -> TwoViews | None:
    """Relative pose from an essential matrix (RANSAC), its length from the first view's depths.

    ``first``, ``second`` (n, 2) are matched ideal pixels, ``first_depths`` (n,) along z, above 0. The unit
    is the median ratio of given to triangulated depth, so single wrong depths do no harm. None where
    there is too little parallax or agreement.
    """
    if len(first) < MIN_MATCHES:
        return None
    cv2.setRNGSeed(seed)
    try:
        essential, mask = cv2.findEssentialMat(
            first, second, camera.matrix, method=cv2.RANSAC, prob=0.999, threshold=EPIPOLAR_PX
        )
        if essential is None or essential.shape != (3, 3) or mask.sum() < MIN_INLIER_SHARE * len(first):
            return None
        _, rotation, translation, _ = cv2.recoverPose(
            essential, first, second, camera.matrix, mask=mask.copy()
        )
    except cv2.error:
        return None  # degenerate matches: all on one spot, say
    first_from_second = inverse(from_rt(np.asarray(rotation, np.float64), np.ravel(translation)))
    points, depth_first, depth_second, parallax = triangulate(
        np.eye(4), first_from_second, rays(camera, first), rays(camera, second)
    )
    good = mask.ravel().astype(bool) & np.isfinite(depth_first) & (depth_first > 0) & (depth_second > 0)
    good &= _reprojects(camera, np.eye(4), points, first)
    good &= _reprojects(camera, first_from_second, points, second)
    wide = good & (parallax > MIN_PARALLAX)
    if wide.sum() < MIN_POINTS:
        return None
    ratios = np.log(first_depths[wide] / depth_first[wide])
    unit = float(np.exp(np.median(ratios)))
    spread = 1.48 * float(np.median(np.abs(ratios - np.median(ratios))))
    first_from_second[:3, 3] *= unit
    return TwoViews(first_from_second, points * unit, parallax, good, spread)


def _reprojects(camera: Camera, view: Array, points: Array, pixels: Array) -> NDArray[np.bool_]:
    local = (points - view[:3, 3]) @ view[:3, :3]
    z = np.where(local[:, 2] > 1e-6, local[:, 2], np.inf)
    projected = local[:, :2] / z[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return np.linalg.norm(projected - pixels, axis=1) < REPROJECTION_PX
