"""The map's unit stays what it was: a bundle adjustment that nothing else sizes may not change it."""

from __future__ import annotations

import numpy as np

from prism_edge.backend.global_map import GlobalMap
from prism_edge.geometry.poses import Array

WELL_SEEN = 3  # keyframes: a point that only two see has followed them, and tells nothing of what was


def keep_unit(world: GlobalMap, held: int, poses: dict[int, Array], points: dict[int, Array]) -> float:
    """Scale a solution about its held keyframe, in place, so that points stay as far away as they were.

    With one pose held nothing but metric depth fixes scale. A network's depths waver; and where there are
    none, or few, round-off and robust kernels let the map shrink by factors within seconds. The scale
    filter says what a unit is in metres, and can only do so while the unit stands still. Returns the
    factor, the median over points that :data:`WELL_SEEN` keyframes see.
    """
    centre = world.keyframes[held].world_from_camera[:3, 3].copy()
    ids = [p for p in points if len(world.points[p].keyframes) >= WELL_SEEN] or list(points)
    if not ids:
        return 1.0
    before = np.linalg.norm([world.points[p].position - centre for p in ids], axis=1)
    after = np.linalg.norm([points[p] - centre for p in ids], axis=1)
    good = (before > 1e-9) & (after > 1e-9)
    if not good.any():
        return 1.0
    factor = float(np.exp(np.median(np.log(before[good] / after[good]))))
    for p, position in points.items():
        points[p] = centre + factor * (position - centre)
    for pose in poses.values():
        pose[:3, 3] = centre + factor * (pose[:3, 3] - centre)
    return factor
