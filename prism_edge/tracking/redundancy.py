"""How well a map would do without a keyframe.

Redundancy is ORB-SLAM's (Mur-Artal et al., 2015, section VI-E): the share of a keyframe's points that at
least three others see as well. It says nothing of what a keyframe joins: three on one side of it will do.
"""

from __future__ import annotations

import numpy as np

from prism_edge.tracking.local_map import NO_POINT, LocalKeyframe, LocalMap

REDUNDANT = 0.9
OTHERS = 3  # keyframes that must see a point before it can do without one more


def redundancy(world: LocalMap, keyframe: LocalKeyframe) -> float:
    """Share of a keyframe's points that at least three other keyframes see; 1 where it sees none."""
    keypoints = keyframe.observed()
    if len(keypoints) == 0:
        return 1.0
    rows = world.points.rows(keyframe.points[keypoints])
    return float((world.points.observations[rows] > OTHERS).mean())


def bridged(world: LocalMap) -> dict[int, float]:
    """Of each keyframe the share of its points that an older one and a newer one see; 1 where it sees none.

    They would do as well without it, and hold together: of a way that is gone but once each keyframe joins
    the one before it to the one after. One that was made long after the one before is bridged by little,
    however many there are behind it: so a map of a long way that is full takes in what is new.
    """
    numbers = sorted(world.keyframes)
    points = [world.keyframes[k].points for k in numbers]
    seen = [ids.compress(ids != NO_POINT) for ids in points]
    rows = world.points.rows(np.concatenate([*seen, np.zeros(0, np.int64)]))
    counts = np.array([len(ids) for ids in seen], np.intp)
    of = np.repeat(np.arange(len(seen)), counts)
    first, last = np.zeros((2, len(world.points) + 1), np.intp)  # that see each point, in order
    last[rows], first[rows[::-1]] = of, of[::-1]  # of several the last assignment holds
    between = (first[rows] < of) & (of < last[rows])
    shares = np.bincount(of[between], minlength=len(seen)) / np.maximum(counts, 1)
    return dict(zip(numbers, np.where(counts > 0, shares, 1.0).tolist(), strict=True))
