"""Structure from the first two views alone: it frees a map from a network that is at a loss."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, from_rt, inverse
from prism_edge.tracking.depth_alignment import robust_sigma
from prism_edge.tracking.point_table import TRIANGULATED_DEG
from prism_edge.tracking.triangulation import rays, triangulate
from prism_edge.tracking.two_view_pose import refine_two_view_pose, sampson_distances

MIN_MATCHES = 60
MIN_POINTS = 50  # triangulated at MIN_PARALLAX
MIN_PARALLAX = np.radians(TRIANGULATED_DEG)
EPIPOLAR_PX = 1.0
REPROJECTION_PX = 2.0
MIN_INLIER_SHARE = 0.3
MIN_KNOWN = 10  # given depths that the unit is the median of
NO_MATCH_PX = 2.0  # from both motions' lines; and what moves by itself costs the true one no more than this
CLEARLY = 1.5  # times the cost


@dataclass(frozen=True)
class TwoViews:
    """Relative pose and points of two views, in the unit of the depths that were given."""

    first_from_second: Array  # (4, 4)
    points: Array  # (n, 3) in the first camera
    parallax: Array  # (n,) rad
    good: NDArray[np.bool_]  # (n,) before both cameras, and reprojecting into both
    depth_spread: float  # of log(given / triangulated) depth, one sigma (robust)
    contradicts: bool  # the matches fit this pose clearly better than the one tracked at the given depths


def reconstruct(
    camera: Camera,
    first: Array,
    second: Array,
    first_depths: Array,
    tracked: Array,
    seed: int,
    least: int = MIN_POINTS,
) -> TwoViews | None:
    """Relative pose from matches alone, its length from the first view's depths.

    Refined both from ``tracked`` (first_from_second as the depths have it) and from an essential matrix
    (RANSAC), which must fit clearly better: at little parallax rotation and translation look alike.

    ``first``, ``second`` (n, 2) are matched ideal pixels, ``first_depths`` (n,) along z, above 0 or NaN
    where none is known. The unit is the median ratio of given to triangulated depth, so single wrong depths
    do no harm. None where there is too little agreement, or fewer than ``least`` matches with parallax.
    """
    if len(first) < MIN_MATCHES:
        return None
    by_essential = essential_pose(camera, first, second, seed)
    if by_essential is None:
        return None
    found, inlier = by_essential
    first_from_second, cost = refine_two_view_pose(camera, first[inlier], second[inlier], found)
    if not np.isfinite(cost):
        return None
    near, near_cost = refine_two_view_pose(camera, first[inlier], second[inlier], tracked)
    if near_cost < CLEARLY * cost:
        first_from_second = _facing(camera, first[inlier], second[inlier], near)
    at_best, at_tracked = (
        np.minimum(sampson_distances(camera, first, second, pose) ** 2, NO_MATCH_PX**2)
        for pose in (first_from_second, tracked)
    )
    contradicts = _among_matches(at_tracked, at_best) > CLEARLY * _among_matches(at_best, at_tracked)
    points, depth_first, depth_second, parallax = triangulate(
        np.eye(4), first_from_second, rays(camera, first), rays(camera, second)
    )
    good = inlier & np.isfinite(depth_first) & (depth_first > 0) & (depth_second > 0)
    good &= _reprojects(camera, np.eye(4), points, first)
    good &= _reprojects(camera, first_from_second, points, second)
    wide = good & (parallax > MIN_PARALLAX)
    known = wide & np.isfinite(first_depths)
    if wide.sum() < least or known.sum() < MIN_KNOWN:
        return None
    ratios = np.log(first_depths[known] / depth_first[known])
    unit = float(np.exp(np.median(ratios)))
    spread = robust_sigma(ratios)
    first_from_second[:3, 3] *= unit
    return TwoViews(first_from_second, points * unit, parallax, good, spread, contradicts)


def essential_pose(
    camera: Camera, first: Array, second: Array, seed: int, method: int = cv2.RANSAC
) -> tuple[Array, NDArray[np.bool_]] | None:
    """Relative pose (first_from_second) by an essential matrix, and which matches (n,) agree.

    Its translation has a length of 1; ``method`` is OpenCV's. None where too few agree.
    """
    cv2.setRNGSeed(seed)
    try:
        essential, mask = cv2.findEssentialMat(
            first, second, camera.matrix, method=method, prob=0.999, threshold=EPIPOLAR_PX
        )
        if essential is None or essential.shape != (3, 3) or mask.sum() < MIN_INLIER_SHARE * len(first):
            return None
        _, rotation, translation, _ = cv2.recoverPose(
            essential, first, second, camera.matrix, mask=mask.copy()
        )
    except cv2.error:
        return None  # degenerate matches: all on one spot, say
    pose = from_rt(np.asarray(rotation, np.float64), np.ravel(translation))
    return inverse(pose), mask.ravel().astype(bool)


def _among_matches(cost: Array, other: Array) -> float:
    """The sum over what is a match by one motion or the other."""
    return float(cost[np.minimum(cost, other) < NO_MATCH_PX**2].sum())


def _facing(camera: Camera, first: Array, second: Array, first_from_second: Array) -> Array:
    """The pose, or the one with its translation turned round: the one that sees its points in front."""
    turned = first_from_second.copy()
    turned[:3, 3] *= -1.0
    ray_a, ray_b = rays(camera, first), rays(camera, second)
    in_front = []
    for pose in (first_from_second, turned):
        _, depth_a, depth_b, _ = triangulate(np.eye(4), pose, ray_a, ray_b)
        in_front.append(int(np.sum((depth_a > 0) & (depth_b > 0))))
    return first_from_second if in_front[0] >= in_front[1] else turned


def _reprojects(camera: Camera, view: Array, points: Array, pixels: Array) -> NDArray[np.bool_]:
    local = (points - view[:3, 3]) @ view[:3, :3]
    z = np.where(local[:, 2] > 1e-6, local[:, 2], np.inf)
    projected = camera.to_pixels(local[:, :2] / z[:, None])
    return np.linalg.norm(projected - pixels, axis=1) < REPROJECTION_PX
