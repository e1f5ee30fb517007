"""Where the camera sat on the robot that made a map: `map` is where the base was at the first keyframe.

So `map` is that mount times the map's own world, whatever mount the camera has now.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from prism_edge.backend.map_file import Info
from prism_edge.errors import MapError
from prism_edge.geometry.poses import Array, are_rotations

FIELD = "base_from_camera"
FARTHEST_M = 1e4  # no robot is so large
RIGID = 1e-6  # what a written one is off by; those of a configuration are exact to rounding
SAME = 1e-6  # metres, and of a rotation's elements: what rounding by hand may have left


def mount_info(mount: Array) -> Info:
    """A mount (4, 4), base_from_camera in metres, for a stored map; read back to the last digit."""
    return {FIELD: mount.tolist()}


def mount_of(info: Info) -> Array | None:
    """The mount (4, 4) that a stored map was made with; None where it doesn't say (earlier builds' maps).

    Raises MapError where it says one that can't be.
    """
    if FIELD not in info:
        return None
    mount = _numbers(info[FIELD])
    if mount is None or not _is_rigid(mount):
        raise MapError(f"the map's {FIELD} is no pose of a camera on a robot")
    return mount


def difference(theirs: Array | None, ours: Array) -> str:
    """How a map's mount, None for unknown, differs from the present one, in words; empty where it doesn't."""
    if theirs is None:
        return "without its camera's place on the robot: the present one is taken"
    return "" if np.abs(theirs - ours).max() <= SAME else "made with the camera elsewhere on the robot"


def _numbers(told: Any) -> Array | None:
    rows = told if isinstance(told, list) and len(told) == 4 else []
    if not rows or not all(isinstance(row, list) and len(row) == 4 for row in rows):
        return None
    if not all(type(n) in (int, float) for row in rows for n in row):
        return None
    try:
        return np.array(rows, np.float64)
    except OverflowError:  # a whole number of any length
        return None


def _is_rigid(mount: Array) -> bool:
    if not (np.abs(mount) <= FARTHEST_M).all():  # which no NaN is
        return False
    return are_rotations(mount[:3, :3], RIGID) and bool((mount[3] == (0.0, 0.0, 0.0, 1.0)).all())
