"""Before two views have had parallax, nothing but a network's depth says how far the camera has moved.

A map begins from one view's depth. A camera that only turns sees no point from a second side: its
orientation is measured, its translation rests on depths that nothing has confirmed, and a pose says so. And
ever after, the wider apart a map's points were seen from, the less it is out of shape.
"""

from __future__ import annotations

import math

import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array
from prism_edge.tracking.local_map import LocalMap
from prism_edge.tracking.point_table import TRIANGULATED_DEG, Index, PointTable

ENOUGH = 20  # matched points that are triangulated
UNOBSERVED = 0.35  # of the scene's depth: what is moved by twice as much shows, whatever the depths are
BEST = 0.25  # of the matched points: what the map's shape rests on
LEAST_PARALLAX_DEG = 0.5  # below it depths are the network's, and no worse for less
FITTED_FOCAL_PX = 525.0  # of the cameras that covariance.drift_* were fitted with
NARROW = 0.27  # breadth of points all over a view of 42 by 32 degrees


class Baselines:
    """The parts of a map in which a frame has seen ENOUGH points from two sides: they have a baseline."""

    def __init__(self) -> None:
        self._parts: set[int] = set()

    def without(self, unobserved: float, part: int) -> float:
        """What a frame that was placed in a part lacks (:func:`unobserved_translation`), others heard."""
        if unobserved == 0.0:
            self._parts.add(part)
        return 0.0 if part in self._parts else unobserved


def unobserved_translation(world: LocalMap, world_from_camera: Array, rows: Index) -> float:
    """Standard deviation of the position of a frame that matches the points in ``rows``, map units.

    Beside what its own points say: 0 where it sees ENOUGH points that two keyframes placed with
    TRIANGULATED_DEG, else UNOBSERVED times the scene's median depth. Orientation is as certain as it is.
    """
    if np.count_nonzero(world.points.parallax_deg[rows] >= TRIANGULATED_DEG) >= ENOUGH:
        return 0.0
    offset = world.points.position[rows] - world_from_camera[:3, 3]
    depth = float(np.median(offset @ world_from_camera[:3, 2])) if len(rows) else 1.0
    return UNOBSERVED * abs(depth)


def best_parallax(table: PointTable, rows: Index, focal_px: float) -> float:
    """Parallax, degrees, under which the BEST of the points in ``rows`` were placed, or more.

    By it a map's shape goes: a point's relative depth is as wrong as its rays' angles are for their parallax.
    It is that of a camera of FITTED_FOCAL_PX whose map would be as good.
    """
    if len(rows) == 0:
        return LEAST_PARALLAX_DEG
    rank = int((1.0 - BEST) * (len(rows) - 1))
    parallax = float(np.partition(table.parallax_deg[rows], rank)[rank])
    return max(parallax / angle_error(focal_px), LEAST_PARALLAX_DEG)


def shift_as_turn(camera: Camera, pixels: Array) -> float:
    """How much of what a way across the view is off by a turn makes up for, 0 to 1; ``pixels`` (n, 2).

    A shift and a turn about the scene's depth move the middle of an image alike (the bas-relief ambiguity),
    and its rim the more differently the farther out it is: all of it, where points lie no farther apart than
    NARROW (root mean square from their middle, at z = 1), less in proportion where they do.
    """
    if len(pixels) == 0:
        return 1.0
    breadth = math.sqrt(float(camera.on_plane(pixels).var(axis=0).sum()))
    return NARROW / max(breadth, NARROW)


def angle_error(focal_px: float) -> float:
    """How far a ray's angle is off beside one of a camera of FITTED_FOCAL_PX.

    Half of its variance is the pixel's, and what else is off (a turned keyframe, a moment) knows no pixels.
    """
    return math.sqrt(0.5 + 0.5 * (FITTED_FOCAL_PX / focal_px) ** 2)
