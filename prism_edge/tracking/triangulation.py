"""Points from two views: matching along epipolar lines, and the rays' nearest point."""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, inverse, skew
from prism_edge.tracking.features import Features
from prism_edge.tracking.matching import best_pairs, hamming
from prism_edge.tracking.point_table import Index

MARGIN_PX = 10.0  # beyond the ends of an epipolar segment
BEFORE = 1e-3  # of the least depth: what a point is before a camera by, at least
MATCH_DISTANCE, MATCH_RATIO = 50, 0.85  # of 256 bits; of the next best's


def rays(camera: Camera, pixels: Array) -> Array:
    """Viewing rays (n, 3) with z = 1 of ideal pixels (n, 2)."""
    return np.column_stack([camera.on_plane(pixels), np.ones(len(pixels))])


def match_epipolar(
    camera_a: Camera,
    camera_b: Camera,
    a_from_b: Array,
    features_a: Features,
    features_b: Features,
    free_a: Index,
    free_b: Index,
    scale_factors: Array,
    depth_range: tuple[float, float],
) -> tuple[Index, Index]:
    """Matches between unclaimed keypoints of two keyframes that satisfy their epipolar geometry.

    ``free_a``, ``free_b`` list keypoints. A match lies within 1.96 sigma of its epipolar line (Hartley
    and Zisserman 9.2), between the line's ends at ``depth_range`` (along z of a, same unit as a_from_b),
    on a like pyramid level. Returns keypoint indices (in a, in b).
    """
    if len(free_a) == 0 or len(free_b) == 0:
        return free_a[:0], free_b[:0]
    ray_a = rays(camera_a, features_a.pixels[free_a])
    pixel_b = features_b.pixels[free_b]
    ray_b = rays(camera_b, pixel_b)
    # ray_a . (t x R ray_b) = 0: the line in b's normalised plane is R^T (ray_a x t) up to sign.
    essential = skew(a_from_b[:3, 3]) @ a_from_b[:3, :3]
    lines = ray_a @ essential
    normal = np.stack([lines[:, 0] / camera_b.fx, lines[:, 1] / camera_b.fy], axis=1)
    lines /= np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
    octave_a, octave_b = features_a.octaves[free_a], features_b.octaves[free_b]
    # Single precision for the one product of all pairs: far finer than the bound it is compared with.
    bounds = 1.96 * scale_factors[octave_b]
    distance = lines.astype(np.float32) @ (ray_b / bounds[:, None]).astype(np.float32).T
    query, other = np.divmod(np.flatnonzero(np.abs(distance) < 1.0), len(free_b))
    b_from_a = inverse(a_from_b)
    low, high = (_project_at(camera_b, b_from_a, ray_a, z) for z in _seen_by(b_from_a, ray_a, depth_range))
    left, right = np.minimum(low[:, 0], high[:, 0]) - MARGIN_PX, np.maximum(low[:, 0], high[:, 0]) + MARGIN_PX
    top, bottom = np.minimum(low[:, 1], high[:, 1]) - MARGIN_PX, np.maximum(low[:, 1], high[:, 1]) + MARGIN_PX
    # Test after test on what is left: all at once costs three times as much.
    x, y = pixel_b[:, 0], pixel_b[:, 1]
    for passed in (
        lambda i, j: np.abs(octave_a[i] - octave_b[j]) <= 1,
        lambda i, j: (x[j] >= left[i]) & (x[j] <= right[i]),
        lambda i, j: (y[j] >= top[i]) & (y[j] <= bottom[i]),
    ):
        keep = passed(query, other)
        query, other = query.compress(keep), other.compress(keep)
    if len(query) == 0:
        return free_a[:0], free_b[:0]
    bits = hamming(features_a.descriptors[free_a[query]], features_b.descriptors[free_b[other]])
    query, other = best_pairs(query, other, bits, MATCH_DISTANCE, MATCH_RATIO)
    return free_a[query], free_b[other]


def _seen_by(camera_from_other: Array, ray: Array, depth_range: tuple[float, float]) -> tuple[Array, Array]:
    """The part of a range of depths along each ray (n, 3) that is before the camera, both (n,).

    A camera that backs up leaves near points behind the keyframe before: projected from there they would be
    on the image's other side.
    """
    low, high = (np.full(len(ray), depth) for depth in depth_range)
    slope, start = ray @ camera_from_other[2, :3], camera_from_other[2, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        edge = np.clip((BEFORE * depth_range[0] - start) / slope, low, high)
    return np.where(slope > 0.0, edge, low), np.where(slope < 0.0, edge, high)


def _project_at(camera: Camera, camera_from_other: Array, ray: Array, depth: Array) -> Array:
    point = ray * depth[:, None] @ camera_from_other[:3, :3].T + camera_from_other[:3, 3]
    z = np.where(np.abs(point[:, 2]) > 1e-6, point[:, 2], 1e-6)
    return camera.to_pixels(point[:, :2] / z[:, None])


def triangulate(
    world_from_a: Array, world_from_b: Array, ray_a: Array, ray_b: Array
) -> tuple[Array, Array, Array, Array]:
    """Midpoints of two sets of rays: world points (n, 3), depths along z in a and in b, parallax (rad).

    ``ray_a``, ``ray_b`` (n, 3) have z = 1 in their camera. Parallel rays give depths of inf, and so do
    those that face each other on one line, whose parallax is pi.
    """
    da = ray_a @ world_from_a[:3, :3].T
    db = ray_b @ world_from_b[:3, :3].T
    base = world_from_b[:3, 3] - world_from_a[:3, 3]
    aa, bb, ab = (np.einsum("ij,ij->i", p, q) for p, q in ((da, da), (db, db), (da, db)))
    pa, pb = da @ base, db @ base
    determinant = aa * bb - ab * ab
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_a = (bb * pa - ab * pb) / determinant
        depth_b = (ab * pa - aa * pb) / determinant
        cosine = ab / np.sqrt(aa * bb)
    depth_a = np.where(determinant > 1e-12, depth_a, np.inf)
    depth_b = np.where(determinant > 1e-12, depth_b, np.inf)
    finite = np.isfinite(depth_a) & np.isfinite(depth_b)
    za, zb = np.where(finite, depth_a, 0.0), np.where(finite, depth_b, 0.0)
    points = 0.5 * (world_from_a[:3, 3] + da * za[:, None] + world_from_b[:3, 3] + db * zb[:, None])
    return points, depth_a, depth_b, np.arccos(np.clip(cosine, -1.0, 1.0))
