"""Before two views have had parallax, nothing but a network's depth says how far the camera has moved.

A map begins from one view's depth. A camera that only turns sees no point from a second side: its orientation
is measured, its translation rests on depths that nothing has confirmed, and a pose says so.
"""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.tracking.local_map import LocalMap
from prism_edge.tracking.point_table import Index

PARALLAX_DEG = 1.0  # as the first two views must have (initialisation.py)
ENOUGH = 20  # matched points with that
UNOBSERVED = 0.7  # of the scene's depth: what is moved by more shows, whatever the depths are
NOTHING = np.zeros((6, 6))


def unobserved_translation(world: LocalMap, world_from_camera: Array, rows: Index) -> Array:
    """What to add to the covariance (6, 6) of a frame that matches the points in ``rows``; map units.

    Until a frame has seen ENOUGH points that two keyframes placed with PARALLAX_DEG, the standard deviation
    of its position is UNOBSERVED times the scene's median depth; from then on, nothing is added. Orientation
    is as certain as it is.
    """
    if world.has_baseline:
        return NOTHING
    if np.count_nonzero(world.points.parallax_deg[rows] >= PARALLAX_DEG) >= ENOUGH:
        world.has_baseline = True
        return NOTHING
    offset = world.points.position[rows] - world_from_camera[:3, 3]
    depth = float(np.median(offset @ world_from_camera[:3, 2])) if len(rows) else 1.0
    return np.diag([(UNOBSERVED * depth) ** 2] * 3 + [0.0] * 3)
