"""What a network says of how large the places of a map are beside each other.

Reprojection ties two rooms that are seen through one door by the few points that both see: their sizes may
differ by a third at next to no cost. A network has the same metres on both sides. Its depths, point by
point, would bend the map, as it flattens what it sees (window.py). So each keyframe says one number, how many
map units a metre is there, and its surroundings are drawn to where that is the same everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from numpy.typing import NDArray

from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.geometry.poses import Array
from prism_edge.tracking.depth_alignment import MIN_ALIGNED, agreement, robust_sigma
from prism_edge.tracking.point_table import TRIANGULATED_DEG

# A network that is unsure within an image is as unsure from place to place; and neighbours err alike, so that
# six keyframes say no more than one.
SHARE, LEAST_SPREAD = 2.5, 0.03
CARRIERS = 10  # points about a keyframe that its number is laid on
# One that says otherwise than the seven about it, or than all by a factor of two, has seen something odd.
BESIDE, ODD, LEAST_SCATTER, FARTHEST_OFF = 3, 3.0, 0.05, math.log(2.0)
FEW = 5  # points may be matched wrongly and agree all the same; what more agree on they know


@dataclass(frozen=True)
class Size:
    """How large the map is about one keyframe."""

    keyframe: int
    log_units: float  # logarithm of map units a metre of network depth
    sigma: float  # of it, beside those of other keyframes
    ranges: dict[int, float]  # points of middling distance and how far they are, map units


def sizes(
    world: GlobalMap,
    keyframes: Iterable[int],
    points: Mapping[int, Iterable[int]],
    any_at_all: bool = False,
) -> list[Size]:
    """Of those keyframes, in the order they were made, whose depth tells near from far.

    ``points`` are what each may speak of; what counts of them is what rays place. ``any_at_all``: all of them
    count, and those keyframes too whose depth hardly tells near from far. They are as unsure as that makes
    them, which is better than nothing where nothing else says how large a place is.
    """
    found = (_size(world, world.keyframes[k], points.get(k, ()), any_at_all) for k in keyframes)
    return [size for size in found if size is not None]


def size_factors(found: list[Size], log_units: float | None = None) -> list[gtsam.NonlinearFactor]:
    """Range factors that draw the surroundings of keyframes of one part to one size, their median.

    ``log_units``: to that size instead.

    Each asks for the range that a point has, times what its keyframe's size is off by, so that all of its
    points together weigh as the keyframe's sigma, and none is drawn nearer than another.
    """
    if not found:
        return []
    said = np.array([size.log_units for size in found])
    median = float(np.median(said)) if log_units is None else log_units
    factors: list[gtsam.NonlinearFactor] = []
    for size, credible in zip(found, _credible(said).tolist(), strict=True):
        stretch = math.exp(median - size.log_units)
        for point, distance in size.ranges.items() if credible else ():
            # Relative to the mean of both: to shrink costs what it costs to grow.
            sigma = size.sigma * math.sqrt(len(size.ranges)) * math.sqrt(stretch) * distance
            noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
            factors.append(gtsam.RangeFactor3D(X(size.keyframe), L(point), stretch * distance, noise))
    return factors


def astray(
    world: GlobalMap, untied: Set[int], votes: list[Size], points: Iterable[int], log_units: float
) -> set[tuple[int, int]]:
    """Observations (keyframe, point) that tie ``untied`` keyframes to others at a size off by a factor.

    A few points are enough to say how large new ground is, and two that were matched wrongly agree with
    whatever they make of it: then nothing but the network's metres tells, which are ``log_units`` map units,
    and of it those images that have one of the ``votes``.
    """
    odd = {vote.keyframe: max(FARTHEST_OFF, ODD * vote.sigma / SHARE) for vote in votes}
    off: dict[int, dict[int, float]] = {k: {} for k in odd}  # of each keyframe's ties; beyond 1 by a factor
    for p in points if odd else ():
        point = world.points[p]
        if point.parallax_deg >= TRIANGULATED_DEG and not point.keyframes <= untied:
            for k in point.keyframes & odd.keys():
                said = _log_units_at(world, k, p)
                if math.isfinite(said):
                    off[k][p] = (said - log_units) / odd[k]
    # Where a keyframe has more ties, or most are right, they have the say.
    wrong = {k: sum(abs(one) > 1.0 for one in ties.values()) for k, ties in off.items()}
    ruled = [k for k, ties in off.items() if len(ties) <= FEW and 2 * wrong[k] > len(ties)]
    found: set[tuple[int, int]] = set()
    for p in {p for k in ruled for p in off[k]}:
        if abs(float(np.median([off[k][p] for k in ruled if p in off[k]]))) > 1.0:
            inside, outside = world.points[p].keyframes & untied, world.points[p].keyframes - untied
            # Either side may keep a point that it sees twice.
            found.update((k, p) for k in (outside if len(inside) > 1 else inside if len(outside) > 1 else ()))
    return found


def _log_units_at(world: GlobalMap, number: int, point: int) -> float:
    """Logarithm of map units a metre of network depth at a point that a keyframe sees; nan: none there."""
    keyframe = world.keyframes[number]
    assert keyframe.depths is not None
    offset = world.points[point].position - keyframe.world_from_camera[:3, 3]
    along_axis = float(offset @ keyframe.world_from_camera[:3, 2])
    metres = float(keyframe.depths[keyframe.observed[point]]) / keyframe.depth_units
    return math.log(along_axis / metres) if along_axis > 1e-6 and metres > 0.0 else math.nan


def _credible(said: Array) -> NDArray[np.bool_]:
    """Which of the log sizes (n,), in the order of their keyframes, are no outliers."""
    about = [np.median(said[max(i - BESIDE, 0) : i + BESIDE + 1]) for i in range(len(said))]
    beside = np.abs(said - about)
    scatter = max(robust_sigma(said - about), LEAST_SCATTER)
    good: NDArray[np.bool_] = (beside < ODD * scatter) & (np.abs(said - np.median(said)) < FARTHEST_OFF)
    return good


def _size(
    world: GlobalMap, keyframe: GlobalKeyframe, points: Iterable[int], any_at_all: bool
) -> Size | None:
    if keyframe.depths is None or keyframe.depth_units <= 0.0:
        return None
    least_parallax_deg = 0.0 if any_at_all else TRIANGULATED_DEG
    firm = {
        p: keyframe.observed[p]
        for p in points
        if world.points[p].parallax_deg >= least_parallax_deg and keyframe.depths[keyframe.observed[p]] > 0.0
    }
    if len(firm) < MIN_ALIGNED:
        return None
    offsets = np.array([world.points[p].position for p in firm]) - keyframe.world_from_camera[:3, 3]
    along_axis: Array = offsets @ keyframe.world_from_camera[:3, 2]
    metres = keyframe.depths[list(firm.values())] / keyframe.depth_units
    front = along_axis > 1e-6
    if front.sum() < MIN_ALIGNED:
        return None
    agreed = agreement(along_axis[front], metres[front])
    if not (agreed.informative or any_at_all):
        return None
    ids = np.array(list(firm))[front]
    ranges = np.linalg.norm(offsets[front], axis=1)
    middle = np.argsort(ranges, kind="stable")[len(ids) // 4 : 3 * len(ids) // 4]
    chosen = middle[np.rint(np.linspace(0, len(middle) - 1, CARRIERS)).astype(np.intp)]
    carriers = dict(zip(ids[chosen].tolist(), ranges[chosen].tolist(), strict=True))
    sigma = SHARE * max(agreed.spread, LEAST_SPREAD)
    return Size(keyframe.id, math.log(agreed.units_per_metre), sigma, carriers)
