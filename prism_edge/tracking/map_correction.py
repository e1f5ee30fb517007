"""Applying what the backend changed to the local map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array, inverse, transform
from prism_edge.tracking.local_map import LocalMap
from prism_edge.tracking.point_table import Ids


def apply_correction(
    world: LocalMap,
    based_on: int,
    keyframe_ids: Ids,
    poses: NDArray[np.float64],
    point_ids: Ids,
    positions: NDArray[np.float64],
) -> Array:
    """Move keyframes and points to where the backend put them.

    What is newer than ``based_on``, which the backend had not seen yet, moves rigidly with it. Returns
    that rigid motion (4, 4), new world from old world near the camera: it carries the current frame.
    """
    index = {int(k): i for i, k in enumerate(keyframe_ids)}
    base = world.keyframes.get(based_on)
    motion = np.eye(4)
    if base is not None and based_on in index:
        motion = poses[index[based_on]] @ inverse(base.world_from_camera)
    table = world.points
    known = table.known(point_ids)
    rows = table.rows(point_ids[known])
    corrected = np.zeros(len(table), bool)
    corrected[rows] = True
    newer = table.alive & ~corrected & (table.reference > based_on)
    table.position[newer] = transform(motion, table.position[newer])
    table.position[rows] = positions[known]
    for keyframe in world.keyframes.values():
        if keyframe.id in index:
            keyframe.world_from_camera = poses[index[keyframe.id]]
        elif keyframe.id > based_on:
            keyframe.world_from_camera = motion @ keyframe.world_from_camera
    return motion
