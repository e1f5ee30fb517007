"""What a window's solve moved, as arrays of a journal's record, and back.

For K keyframes and M points (map units, in the map's frame) and D observations that were dropped:

============ =========== ==============================================
solved       i8 (K)      keyframes
poses        f8 (K,4,4)  world_from_camera
points       i8 (M)      numbers
positions    f4 (M,3)    half a message's size; to 0.01 mm within 100 units
parallax_deg f4 (M)      widest angle between a point's rays
dropped      i8 (D,2)    keyframe, point
============ =========== ==============================================
"""

from __future__ import annotations

import numpy as np

from prism_edge.backend.map_file import Arrays
from prism_edge.backend.window import Solution
from prism_edge.messages import MapUpdate


def solved_arrays(update: MapUpdate) -> Arrays:
    """Of a window's update."""
    return {
        "solved": update.keyframes,
        "poses": update.poses,
        "points": update.points,
        "positions": update.positions.astype(np.float32),
        "parallax_deg": update.parallax_deg,
        "dropped": np.stack([update.dropped_keyframes, update.dropped_points], axis=1),
    }


def solution_of(arrays: Arrays) -> Solution:
    """What :func:`solved_arrays` was given. Raises KeyError or ValueError for what can't be."""
    keyframes, points = arrays["solved"].tolist(), arrays["points"].tolist()
    poses, positions = arrays["poses"].astype(np.float64), arrays["positions"].astype(np.float64)
    if not (np.isfinite(poses).all() and np.isfinite(positions).all()):
        raise ValueError("a solved window holds values that can't be")
    return Solution(
        poses=dict(zip(keyframes, poses.reshape(-1, 4, 4), strict=True)),
        points=dict(zip(points, positions.reshape(-1, 3), strict=True)),
        parallax_deg=dict(zip(points, arrays["parallax_deg"].tolist(), strict=True)),
        outliers=[(k, p) for k, p in arrays["dropped"].reshape(-1, 2).tolist()],
        iterations=0,
    )
