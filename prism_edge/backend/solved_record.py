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
from prism_edge.backend.stored_map import FARTHEST
from prism_edge.backend.window import Solution
from prism_edge.errors import MapError
from prism_edge.messages import MapUpdate


def solved_arrays(update: MapUpdate) -> Arrays:
    """Of a window's update; a point that ran off is left out, as of a stored map."""
    near = np.abs(update.positions).max(axis=1, initial=0.0) < FARTHEST
    return {
        "solved": update.keyframes,
        "poses": update.poses,
        "points": update.points[near],
        "positions": update.positions[near].astype(np.float32),
        "parallax_deg": update.parallax_deg[near],
        "dropped": np.stack([update.dropped_keyframes, update.dropped_points], axis=1),
    }


def solution_of(arrays: Arrays) -> Solution:
    """What :func:`solved_arrays` was given. Raises MapError for what can't be."""
    try:
        keyframes, points = arrays["solved"].tolist(), arrays["points"].tolist()
        poses, positions = arrays["poses"].astype(np.float64), arrays["positions"].astype(np.float64)
        if not (np.isfinite(poses).all() and np.isfinite(positions).all()):
            raise MapError("a solved window holds values that can't be")
        return Solution(
            poses=dict(zip(keyframes, poses.reshape(-1, 4, 4), strict=True)),
            points=dict(zip(points, positions.reshape(-1, 3), strict=True)),
            parallax_deg=dict(zip(points, arrays["parallax_deg"].tolist(), strict=True)),
            outliers=[(k, p) for k, p in arrays["dropped"].reshape(-1, 2).tolist()],
            iterations=0,
        )
    except (KeyError, ValueError) as error:
        raise MapError(f"a solved window is none: {error}") from None
