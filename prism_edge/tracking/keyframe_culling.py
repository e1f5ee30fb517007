"""A bounded local map: which keyframe goes when there are too many, and what goes with it.

Redundancy is ORB-SLAM's (Mur-Artal et al., 2015, section VI-E): the share of a keyframe's points that at
least three others see as well. There every keyframe beyond 90 % goes. Here a map of ordinary size keeps them,
for they make its points surer; of a larger one, which may grow for weeks, those about the camera go. And of
any map those that only stood in for a keyframe of the same place: a robot that stays makes more and more.
"""

from __future__ import annotations

import logging

import numpy as np

from prism_edge.tracking.keyframe_decision import RECENT, same_view
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap

log = logging.getLogger("prism_edge.tracking")

REDUNDANT = 0.9
OTHERS = 3  # keyframes that must see a point before it can do without one more
MIN_VIEWERS = 2  # a point with fewer is one that nothing would correct any more


def cull_keyframes(world: LocalMap, most: int, most_redundant: int) -> list[int]:
    """Drop keyframes until there are at most ``most`` (3 or more); returns their ids.

    Beyond ``most_redundant`` the redundant ones go that share points with the newest. Neither the newest go,
    nor the first: its camera is where the world's frame is, and what everything after was placed from.
    """
    dropped = []
    while len(world.keyframes) > min(most, most_redundant):
        gone = _redundant(world) if len(world.keyframes) > most_redundant else None
        if gone is None and len(world.keyframes) > most:
            # Of equally redundant ones the oldest goes first.
            candidates = sorted(world.keyframes)[1 : -min(RECENT, most - 1)]
            gone = max(candidates, key=lambda k: (redundancy(world, world.keyframes[k]), -k))
        if gone is None:
            break
        drop_keyframe(world, world.keyframes[gone])
        dropped.append(gone)
    return dropped


def cull_stand_in(world: LocalMap) -> list[int]:
    """Drop the keyframe that has just ceased to be one of the newest, if it is of a known place; its id.

    It is redundant, and an older one shows the same: what it was made for (keyframe_decision.py) is done.
    """
    numbers = sorted(world.keyframes)
    if len(numbers) < RECENT + 2:
        return []
    older, keyframe = numbers[: -RECENT - 1], world.keyframes[numbers[-RECENT - 1]]
    if redundancy(world, keyframe) <= REDUNDANT:
        return []
    depth = world.median_depth(keyframe)
    shown = same_view([world.keyframes[k] for k in older], keyframe.world_from_camera, keyframe.points, depth)
    if shown is None:
        return []
    drop_keyframe(world, keyframe)
    return [keyframe.id]


def _redundant(world: LocalMap) -> int | None:
    """A neighbour of the newest keyframe that may go, the latest such: what placed a room first stays.

    Were it the other way about, the map of one room would be made anew again and again, and creep.
    """
    candidates = sorted(world.keyframes)[1:-RECENT]
    near = set(world.newest().neighbours).intersection(candidates)
    return max((k for k in near if redundancy(world, world.keyframes[k]) > REDUNDANT), default=None)


def redundancy(world: LocalMap, keyframe: LocalKeyframe) -> float:
    """Share of a keyframe's points that at least three other keyframes see; 1 where it sees none."""
    keypoints = keyframe.observed()
    if len(keypoints) == 0:
        return 1.0
    rows = world.points.rows(keyframe.points[keypoints])
    return float((world.points.observations[rows] > OTHERS).mean())


def drop_keyframe(world: LocalMap, keyframe: LocalKeyframe) -> None:
    """Take a keyframe out of the map; points that fewer than two keyframes see without it go too.

    The others that it was the first to see are handed on to the oldest keyframe that sees them: its ray is
    their reference from then on. Ids are never used again.
    """
    table = world.points
    del world.keyframes[keyframe.id]
    rows = table.rows(keyframe.points[keyframe.observed()])
    table.observations[rows] -= 1
    lonely = rows[table.observations[rows] < MIN_VIEWERS]
    world.cull_points(lonely)
    _hand_on_references(world, keyframe.id)
    world.changes.culled_keyframes.append(keyframe.id)
    log.debug("keyframe %d is culled, and %d points with it", keyframe.id, len(lonely))


def _hand_on_references(world: LocalMap, gone: int) -> None:
    table = world.points
    orphaned = table.alive & (table.reference == gone)
    for keyframe in sorted(world.keyframes.values(), key=lambda k: k.id):
        if not orphaned.any():
            return
        keypoints = keyframe.observed()
        rows = table.rows(keyframe.points[keypoints])
        mine = np.flatnonzero(orphaned[rows])
        table.reference[rows[mine]] = keyframe.id
        table.reference_keypoint[rows[mine]] = keypoints[mine]
        orphaned[rows[mine]] = False
