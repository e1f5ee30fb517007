"""How well a map would do without a keyframe.

Redundancy is ORB-SLAM's (Mur-Artal et al., 2015, section VI-E): the share of a keyframe's points that at
least three others see as well.
"""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap

REDUNDANT = 0.9
OTHERS = 3  # keyframes that must see a point before it can do without one more


def redundancy(world: LocalMap, keyframe: LocalKeyframe) -> float:
    """Share of a keyframe's points that at least three other keyframes see; 1 where it sees none."""
    keypoints = keyframe.observed()
    if len(keypoints) == 0:
        return 1.0
    rows = world.points.rows(keyframe.points[keypoints])
    return float((world.points.observations[rows] > OTHERS).mean())


class Redundancies:
    """Those of some keyframes, looked up once: what changes while others are culled is only counts.

    Good for as long as the map gets no observations, and its table is not squeezed.
    """

    def __init__(self, world: LocalMap, numbers: list[int]) -> None:
        keyframes, self._world, self._count = [world.keyframes[k] for k in numbers], world, len(numbers)
        seen = [world.points.rows(keyframe.points[keyframe.observed()]) for keyframe in keyframes]
        self._rows = np.concatenate([*seen, np.zeros(0, np.intp)])
        self._of = np.repeat(np.arange(len(seen)), [len(rows) for rows in seen])

    def now(self) -> Array:
        """:func:`redundancy` (n,) of each of the keyframes, in order; nonsense where it is culled."""
        table = self._world.points
        alive = table.alive[self._rows]
        enough = alive & (table.observations[self._rows] > OTHERS)
        points, shared = (np.bincount(self._of[chosen], minlength=self._count) for chosen in (alive, enough))
        return np.where(points > 0, shared / np.maximum(points, 1), 1.0)
