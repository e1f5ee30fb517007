"""What hangs together in a map: by any shared point, or by covisibility that a correction may follow."""

from __future__ import annotations

import heapq
import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from prism_edge.backend.global_map import GlobalMap
from prism_edge.geometry.poses import rotation_angle
from prism_edge.messages import HOME
from prism_edge.tracking.point_table import Ids

Edges = dict[tuple[int, int], float]  # pairs of keyframes, the older first, and how many points they share

MANY_SHARED = 50  # every such pair is joined; of the others each keyframe with its best few
BEST_FEW = 3
FEW_SHARED = 10  # fewer may be chance matches: they join nothing
MOST_AT_ONCE = 1_000_000  # pairs counted: where hundreds see each point a map has hundreds of millions
LOOPED = 30.0  # shared points that a loop counts as, or having been followed from one to the other


class Way(NamedTuple):
    """From one keyframe to another."""

    length: float  # map units
    turned: float  # rad, all turns added up


def hanging_together(world: GlobalMap, keyframe: int) -> set[int]:
    """A keyframe and all that shares points with it, or with others that do."""
    found, fresh = {keyframe}, [keyframe]
    passed: set[int] = set()  # points whose viewers have been found
    while fresh and len(found) < len(world.keyframes):
        seen = world.keyframes[fresh.pop()].observed.keys() - passed
        passed |= seen
        new = set().union(*(world.points[p].keyframes for p in seen)) - found
        found |= new
        fresh += sorted(new)
    return found


def parts_of(world: GlobalMap) -> dict[int, int]:
    """The part of each keyframe that is not at home: where it lies is unknown until a loop joins it.

    What hangs together by points is of one part: at home where one of its keyframes was made there, else of
    the oldest that one was made in (tracking/submaps.py). Where nobody has said that, home is what hangs
    together with the first keyframe, and each other part is named by its own first.
    """
    part: dict[int, int] = {}
    for start in sorted(world.keyframes):
        if start not in part:
            group = hanging_together(world, start)
            told = (world.keyframes[k].part for k in group)
            unsaid = start if part else HOME
            part.update(dict.fromkeys(group, min((of for of in told if of is not None), default=unsaid)))
    return {k: of for k, of in part.items() if of != HOME}


def covisibility(world: GlobalMap, loops: list[tuple[int, int]]) -> Edges:
    """Edges between keyframes that share enough points, and those that loops have joined so far."""
    found: Edges = {}
    older, newer, shared = shared_points(world)
    enough = np.flatnonzero(shared >= FEW_SHARED)
    most_first = enough[np.lexsort((-older[enough], -shared[enough], newer[enough]))]
    columns = (column[most_first].tolist() for column in (older, newer, shared))
    rank, of = 0, -1  # among those that a keyframe has before it
    for a, b, count in zip(*columns, strict=True):
        rank, of = (rank + 1 if b == of else 0), b
        if count >= MANY_SHARED or rank < BEST_FEW:
            found[a, b] = float(count)
    for a, b in loops:
        if a in world.keyframes and b in world.keyframes:
            found.setdefault((min(a, b), max(a, b)), LOOPED)
    return found


def with_bridges(world: GlobalMap, edges: Edges) -> Edges:
    """The edges, and where they break within one part of the map one along the camera's own way.

    Keyframes that were never heard of (the backend was started anew while the camera turned) leave the next
    no point that it shares with those before; yet the camera was followed all along, so drift has its bounds.
    """
    found = dict(edges)
    piece = {k: number for number, joined in enumerate(_pieces(world, edges)) for k in joined}
    last: dict[int, int] = {}  # keyframe of each part
    for k in sorted(world.keyframes):
        of = world.keyframes[k].part
        if of is None:
            continue
        before = last.get(of, k)
        if piece[before] != piece[k]:
            found[before, k] = LOOPED
            piece.update({other: piece[before] for other, now in piece.items() if now == piece[k]})
        last[of] = k
    return found


def shared_points(world: GlobalMap) -> tuple[Ids, Ids, Ids]:
    """Every two keyframes that share points (n): the older one, the newer one, and how many."""
    numbers = np.array(sorted(world.keyframes), np.int64)
    row = {k: i for i, k in enumerate(numbers.tolist())}
    viewers: dict[int, list[int]] = {}  # by how many each point has: those of all such points in a row
    for point in world.points.values():
        if len(point.keyframes) > 1:
            viewers.setdefault(len(point.keyframes), []).extend(row[k] for k in point.keyframes)
    found, shared = np.zeros(0, np.int64), np.zeros(0, np.int64)
    for many, rows in viewers.items():
        seeing = np.sort(np.array(rows, np.int64).reshape(-1, many), axis=1)
        newer, older = np.tril_indices(many, -1)
        for some in np.array_split(seeing, math.ceil(len(seeing) * len(newer) / MOST_AT_ONCE)):
            pairs, times = np.unique(len(numbers) * some[:, newer] + some[:, older], return_counts=True)
            found, where = np.unique(np.concatenate([found, pairs]), return_inverse=True)
            shared = np.bincount(where, np.concatenate([shared, times])).astype(np.int64)
    return numbers[found % len(numbers)], numbers[found // len(numbers)], shared


def reachable(edges: Edges, start: set[int]) -> set[int]:
    """Keyframes to which edges lead from some, those included."""
    near: dict[int, list[int]] = {}
    for a, b in edges:
        near.setdefault(a, []).append(b)
        near.setdefault(b, []).append(a)
    seen, front = set(start), list(start)
    while front:
        for k in near.get(front.pop(), []):
            if k not in seen:
                seen.add(k)
                front.append(k)
    return seen


def joined_pieces(world: GlobalMap, loops: list[tuple[int, int]]) -> list[set[int]]:
    """Keyframes that edges join; the first keyframe's come first."""
    return _pieces(world, covisibility(world, loops))


def _pieces(world: GlobalMap, edges: Edges) -> list[set[int]]:
    left, found = set(world.keyframes), []
    while left:
        found.append(reachable(edges, {min(left)}) & left)
        left -= found[-1]
    return found


def ways(world: GlobalMap, edges: Edges, start: int) -> dict[int, Way]:
    """The shortest way from one keyframe to others by edges as strong as a loop at least."""
    near: dict[int, list[tuple[int, float]]] = {}
    for (a, b), shared in edges.items():
        if shared >= LOOPED:
            here, there = world.keyframes[a].world_from_camera, world.keyframes[b].world_from_camera
            step = math.dist(here[:3, 3], there[:3, 3])
            near.setdefault(a, []).append((b, step))
            near.setdefault(b, []).append((a, step))
    found: dict[int, Way] = {}
    front = [(0.0, start, start)]
    while front:
        length, k, before = heapq.heappop(front)
        if k not in found:
            turned = found[before].turned + _turn(world, before, k) if found else 0.0
            found[k] = Way(length, turned)
            for other, step in near.get(k, []):
                if other not in found:
                    heapq.heappush(front, (length + step, other, k))
    return found


def own_way(world: GlobalMap, one: int, other: int) -> Way:
    """The camera's own between two keyframes; its turns by those that are left of what it made there."""
    first, last = sorted((one, other))
    passed = [k for k in sorted(world.keyframes) if first <= k <= last]
    travelled = abs(world.keyframes[other].travelled - world.keyframes[one].travelled)
    return Way(travelled, sum(_turn(world, a, b) for a, b in pairwise(passed)))


def _turn(world: GlobalMap, one: int, other: int) -> float:
    here, there = world.keyframes[one].world_from_camera, world.keyframes[other].world_from_camera
    return rotation_angle(here[:3, :3].T @ there[:3, :3])
