"""Points seeded from network depth: a keyframe's unclaimed keypoints get the depth of their pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array, transform
from prism_edge.tracking.depth_alignment import MIN_ALIGNED, DepthAlignment
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap
from prism_edge.tracking.point_table import TRIANGULATED_DEG, Ids, Index
from prism_edge.tracking.triangulation import rays

MAX_EDGE_RATIO = 1.25  # of depths round a pixel: beyond it the pixel straddles an edge
ANYWHERE = 0.5  # sigma of a log depth that nobody knows


def sample_depth(
    depth: NDArray[np.float32], image_to_depth: Array, pixels: Array
) -> tuple[NDArray[np.bool_], Array]:
    """Depth (n,) of the nearest pixel for image pixels (n, 2), and which are usable (valid, off edges)."""
    height, width = depth.shape
    if min(height, width) < 3 or not np.all(np.isfinite(image_to_depth)):
        return np.zeros(len(pixels), bool), np.zeros(len(pixels))
    at_x = np.rint(pixels[:, 0] * image_to_depth[0] + image_to_depth[1])
    at_y = np.rint(pixels[:, 1] * image_to_depth[2] + image_to_depth[3])
    x, y = np.clip(at_x, -1, width).astype(np.intp), np.clip(at_y, -1, height).astype(np.intp)
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    x, y = np.clip(x, 1, width - 2), np.clip(y, 1, height - 2)
    around = np.stack([depth[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    low, high = around.min(axis=0), around.max(axis=0)
    good = inside & (low > 0) & (high < MAX_EDGE_RATIO * low)
    return good, around[4].astype(np.float64)


def seed_from_depth(
    world: LocalMap,
    keyframe: LocalKeyframe,
    depth: NDArray[np.float32],
    image_to_depth: Array,
    units_per_metre: float,
    relative_sigma: float,
    most: int,
) -> Ids:
    """Add points at the free keypoints of a keyframe from its network depth (metres), which it keeps.

    Where the keyframe sees enough triangulated points, their own ratios to the network's depth place
    the seeds in the map's unit (depth_alignment.py); elsewhere ``units_per_metre`` does.
    """
    alignment = None
    raw = keyframe.camera.distort_pixels(keyframe.features.pixels)
    good, metres = sample_depth(depth, image_to_depth, raw)
    keypoints, map_depth = world.depths_in(keyframe)
    rows = world.points.rows(keyframe.points[keypoints])
    told = (world.points.parallax_deg[rows] >= TRIANGULATED_DEG) & (map_depth > 0) & good[keypoints]
    if told.sum() >= MIN_ALIGNED:
        size = (keyframe.camera.width, keyframe.camera.height)
        at = keypoints[told]
        alignment = DepthAlignment.of(raw[at], map_depth[told], metres[at], size)
        if not alignment.overall.informative:
            return seed_at_middle(world, keyframe, most)
    keyframe.metres = np.where(good, metres, 0.0)
    free = keyframe.free()
    chosen: Index = free[good[free]][:most]
    if len(chosen) == 0:
        return np.zeros(0, np.int64)
    units, sigma = np.full(len(chosen), units_per_metre), np.full(len(chosen), relative_sigma)
    if alignment is not None:
        units, sigma = alignment.at(raw[chosen])
    local = rays(keyframe.camera, keyframe.features.pixels[chosen]) * (metres[chosen] * units)[:, None]
    return world.add_points(keyframe, chosen, transform(keyframe.world_from_camera, local), sigma, 0.0)


def seed_at_middle(world: LocalMap, keyframe: LocalKeyframe, most: int) -> Ids:
    """Where depth is of no use: add points at the median depth of those seen, until there are ``most``.

    A camera that turns needs something to hold on to, and what a point says of turns it says wherever on its
    ray it is. One with points enough has no need of them.
    """
    seen = len(keyframe.observed())
    free = keyframe.free()[: max(most - seen, 0)]
    if not seen or len(free) == 0:
        return np.zeros(0, np.int64)
    local = rays(keyframe.camera, keyframe.features.pixels[free]) * world.median_depth(keyframe)
    sigma = np.full(len(free), ANYWHERE)
    return world.add_points(keyframe, free, transform(keyframe.world_from_camera, local), sigma, 0.0)
