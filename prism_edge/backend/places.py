"""Where the newest keyframe may have been before: retrieval, before any geometry."""

from __future__ import annotations

from collections.abc import Container

import numpy as np

from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.loops import median_depth
from prism_edge.geometry.poses import inverse, rotation_angle
from prism_edge.tracking.place_index import PlaceIndex

RECENT = 10  # keyframes before a keyframe that can't be a return to a place
RECENT_S = 3.0  # nor any so shortly before: what is in sight again so soon is often a thing that moves
FEW_SHARED = 15  # a loop counts between keyframes that share fewer points than this
SOME_SHARED = 3  # and from so many on it is likely to be one
SAME_PLACE = 60  # keyframes that share this many show one place: one of them is enough


def candidates(
    world: GlobalMap, index: PlaceIndex, query: int, most: int, without: Container[int] = ()
) -> list[int]:
    """At most ``most`` earlier keyframes that look like ``query``, most alike first (paper, section 3.5).

    Left out are the latest before it, by number and by time, those that share points with it already, those
    that show the same place as a better candidate, and those in ``without``.
    """
    descriptor = index.get(query)
    if descriptor is None or query not in world.keyframes:
        return []
    ranked = index.rank(descriptor, _earlier(world, query, without))
    return _one_of_each_place(world, [k for k, _ in ranked], most)


def half_known(world: GlobalMap, query: int, most: int, without: Container[int]) -> list[int]:
    """As :func:`candidates`, but those that share a few points with ``query``, nearest view first.

    The tracker has begun to find such a place again by itself; from beside where it was seen then, more of it
    is likely to be found. Near is what is little turned, and little moved for how far the points are.
    """
    if query not in world.keyframes:
        return []
    view, shared = world.keyframes[query], dict(world.covisible(query))
    some = [k for k in _earlier(world, query, without) if shared.get(k, 0) >= SOME_SHARED]
    depth = median_depth(world, view)

    def farness(k: int) -> float:
        motion = inverse(view.world_from_camera) @ world.keyframes[k].world_from_camera
        return float(np.linalg.norm(motion[:3, 3])) / depth + rotation_angle(motion[:3, :3])

    return _one_of_each_place(world, sorted(some, key=farness), most)


def _earlier(world: GlobalMap, query: int, without: Container[int]) -> list[int]:
    """Keyframes long enough before one that a loop between them would count."""
    earlier = sorted(k for k in world.keyframes if k < query)[:-RECENT]
    shared = dict(world.covisible(query))
    now = world.keyframes[query].stamp_ns
    old = (k for k in earlier if abs(now - world.keyframes[k].stamp_ns) >= 1e9 * RECENT_S)
    return [k for k in old if shared.get(k, 0) < FEW_SHARED and k not in without]


def _one_of_each_place(world: GlobalMap, best_first: list[int], most: int) -> list[int]:
    chosen: list[int] = []
    covered: set[int] = set()
    for k in best_first:
        if len(chosen) == most:
            break
        if k not in covered:
            chosen.append(k)
            covered.update(other for other, count in world.covisible(k) if count >= SAME_PLACE)
    return chosen
