"""A bounded local map: which keyframe goes when there are too many, and what goes with it.

In ORB-SLAM every redundant keyframe (redundancy.py) goes. Here a map of ordinary size keeps them, for they
make its points surer; of a larger one, which may grow for weeks, those about the camera go. And of any map
those that only stood in for a keyframe of the same place: a robot that stays makes more and more.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator
from itertools import chain, islice

import numpy as np

from prism_edge.config import TrackingConfig
from prism_edge.tracking.keyframe_decision import RECENT, same_view
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap
from prism_edge.tracking.redundancy import REDUNDANT, bridged, redundancy
from prism_edge.tracking.relocalisation import Relocaliser
from prism_edge.tracking.submaps import Parts

log = logging.getLogger("prism_edge.tracking")

AT_ONCE = 5  # of the keyframes that a map has too many: each costs some milliseconds
MIN_VIEWERS = 2  # a point with fewer is one that nothing would correct any more


def keeping_bound(
    world: LocalMap, parts: Parts, places: Relocaliser, config: TrackingConfig
) -> Iterator[None]:
    """All that a new keyframe costs the map, step by step.

    Between steps frames may be tracked in it, but no keyframe may come or go.
    """
    bounds = config.max_keyframes, config.redundant_keyframes
    for gone in chain(cull_stand_in(world), culling(world, *bounds, parts.small(RECENT), AT_ONCE)):
        places.forget(gone)
        parts.forget(gone)
        yield
    world.points.squeeze()


def culling(
    world: LocalMap, most: int, most_redundant: int, small: Collection[int] = (), at_once: int | None = None
) -> Iterator[int]:
    """Drop keyframes until there are at most ``most`` (3 or more); their ids, each once it is gone.

    Beyond ``most_redundant`` the redundant ones go that share points with the newest. Neither the newest go,
    nor the first: its camera is where the world's frame is, and what everything after was placed from.
    Beyond ``most`` those of ``small`` parts go first, which nobody has joined to the map since, the oldest
    before all; and ``at_once`` at most: a map may come with many too many.
    """
    surplus = islice(_surplus(world, most, small), at_once)
    while len(world.keyframes) > min(most, most_redundant):
        gone = _redundant(world) if len(world.keyframes) > most_redundant else None
        if gone is None and len(world.keyframes) > most:
            gone = next(surplus, None)
        if gone is None:
            break
        drop_keyframe(world, world.keyframes[gone])
        yield gone


def _surplus(world: LocalMap, most: int, small: Collection[int]) -> Iterator[int]:
    """What a map of too many can do without: the oldest of ``small`` parts, or else what is bridged best.

    Of equals the oldest goes first.
    """
    newest = min(RECENT, most - 1)
    while True:
        numbers = sorted(world.keyframes)[1:-newest]
        loose = min((k for k in numbers if k in small), default=None)
        if loose is None:
            shares = bridged(world)
            loose = max(numbers, key=lambda k: (shares[k], -k))
        yield loose


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
    often = [k for k in near if redundancy(world, world.keyframes[k]) > REDUNDANT]
    shares = bridged(world) if often else {}
    return max((k for k in often if shares[k] > REDUNDANT), default=None)


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


def take_out(world: LocalMap, parts: Parts, places: Relocaliser, keyframe: LocalKeyframe) -> None:
    """Drop a keyframe, and with it what its part and the places that can be recognised know of it."""
    drop_keyframe(world, keyframe)
    parts.forget(keyframe.id)
    places.forget(keyframe.id)


def _hand_on_references(world: LocalMap, gone: int) -> None:
    table = world.points
    orphaned = table.alive & (table.reference == gone)
    for keyframe in sorted(world.may_see(table.ids[orphaned]), key=lambda k: k.id):
        if not orphaned.any():
            return
        keypoints = keyframe.observed()
        rows = table.rows(keyframe.points[keypoints])
        mine = np.flatnonzero(orphaned[rows])
        table.reference[rows[mine]] = keyframe.id
        table.reference_keypoint[rows[mine]] = keypoints[mine]
        orphaned[rows[mine]] = False
