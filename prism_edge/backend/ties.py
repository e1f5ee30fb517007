"""Which keyframes of a window have their size from the poses that are held.

A camera's place beside points is as large as the points are far, and those are placed by rays from elsewhere:
size goes from keyframe to keyframe through points that those before have placed. A turn on the spot breaks
that: what comes into view has been seen from one place alone, and whatever is made of it when the camera
drives on may be of any size.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prism_edge.backend.global_map import GlobalMap
from prism_edge.geometry.poses import Array

LEAST_PLACED, PLACED_DEG = 20, 3.0  # points, under so much parallax, tie a keyframe to those who saw them


def untied(world: GlobalMap, held: list[int], free: list[int], points: list[int]) -> list[int]:
    """Of the ``free`` keyframes, in their order, those that no chain of ``points`` ties to the ``held`` ones.

    The poses that are held are as large as each other, and tied: they alone place points to begin with.
    """
    if not free or not points:
        return list(free)
    members = [*held, *free]
    seen, rays = _sight(world, members, points)
    tied = np.zeros(len(members), bool)
    tied[: len(held)] = True
    while not tied.all():
        placed = _parallax(rays, seen & tied) >= np.radians(PLACED_DEG)
        more = ~tied & ((seen & placed[:, None]).sum(axis=0) >= LEAST_PLACED)
        if not more.any():
            break
        tied |= more
    return [k for k, is_tied in zip(members, tied.tolist(), strict=True) if not is_tied]


def at_one_spot(world: GlobalMap, held: list[int]) -> bool:
    """Whether even the ``held`` poses farthest apart don't place what the newest of them sees."""
    centres = np.array([world.keyframes[k].world_from_camera[:3, 3] for k in held])
    widest = np.linalg.norm(centres[:, None] - centres, axis=2).max()
    return bool(widest < np.radians(PLACED_DEG) * median_range(world, max(held)))


def median_range(world: GlobalMap, number: int) -> float:
    """How far the points are that a keyframe sees, map units; 0 where it sees none."""
    keyframe = world.keyframes[number]
    places = np.array([world.points[p].position for p in keyframe.observed]).reshape(-1, 3)
    ranges = np.linalg.norm(places - keyframe.world_from_camera[:3, 3], axis=1)
    return float(np.median(ranges)) if len(ranges) else 0.0


def _sight(world: GlobalMap, members: list[int], points: list[int]) -> tuple[NDArray[np.bool_], Array]:
    """Which members (columns) see which points (rows), and unit rays (rows, columns, 3)."""
    column = {k: i for i, k in enumerate(members)}
    seen = np.zeros((len(points), len(members)), bool)
    for row, p in enumerate(points):
        for k in world.points[p].keyframes & column.keys():
            seen[row, column[k]] = True
    centres = np.array([world.keyframes[k].world_from_camera[:3, 3] for k in members])
    rays = np.array([world.points[p].position for p in points])[:, None] - centres
    rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-12)
    return seen, rays


def _parallax(rays: Array, among: NDArray[np.bool_]) -> Array:
    """Angle (n,), rad, between the first of each point's rays ``among`` and the one farthest from it."""
    first = rays[np.arange(len(rays)), among.argmax(axis=1)]
    cosine = np.where(among, np.einsum("nij,nj->ni", rays, first), 1.0)
    return np.arccos(np.clip(cosine.min(axis=1), -1.0, 1.0))
