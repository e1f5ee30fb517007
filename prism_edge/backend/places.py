"""Where the newest keyframe may have been before: retrieval, before any geometry."""

from __future__ import annotations

from collections.abc import Container

from prism_edge.backend.global_map import GlobalMap
from prism_edge.tracking.place_index import PlaceIndex

RECENT = 10  # keyframes before a keyframe that can't be a return to a place
RECENT_S = 3.0  # nor any so shortly before: what is in sight again so soon is often a thing that moves
FEW_SHARED = 15  # a loop counts between keyframes that share fewer points than this
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
    earlier = sorted(k for k in world.keyframes if k < query)
    shared = dict(world.covisible(query))
    now = world.keyframes[query].stamp_ns
    old = (k for k in earlier[:-RECENT] if abs(now - world.keyframes[k].stamp_ns) >= 1e9 * RECENT_S)
    among = [k for k in old if shared.get(k, 0) < FEW_SHARED and k not in without]
    chosen: list[int] = []
    covered: set[int] = set()
    for k, _ in index.rank(descriptor, among):
        if k in covered:
            continue
        chosen.append(k)
        if len(chosen) == most:
            break
        covered.update(other for other, count in world.covisible(k) if count >= SAME_PLACE)
    return chosen
