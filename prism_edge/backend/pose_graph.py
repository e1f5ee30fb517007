"""A loop's correction spread over the keyframes between its ends: similarities joined by covisibility.

The unit of a monocular map drifts as its poses do, so each keyframe is a similarity (Strasdat et al., RSS
2010): a point of its camera is at scale * R p + c in the world. Joined are keyframes that share points, by
their present relative poses, and the two of the loop by what was measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from prism_edge.backend.connectivity import covisibility, hanging_together, reachable, with_bridges
from prism_edge.backend.frame import take_references
from prism_edge.backend.free_points import doubt
from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.loops import Loop, median_depth
from prism_edge.geometry.poses import Array, from_rt, inverse, normalised

TURN, SHIFT, STRETCH = 0.01, 0.02, 0.01  # sigmas of a joint: rad, median depths, log scale
LOOP_SHARE = 0.3  # of those sigmas, for a loop
ITERATIONS = 20
CONVERGED = 1e-5


@dataclass(frozen=True)
class Similarity:
    """``world = scale * rotation @ camera + centre``: a keyframe's pose and its unit in the map's."""

    world_from_camera: Array
    scale: float
    unit: float = 1.0  # of that, what comes of another unit; the rest is drift that was taken out

    def move(self, before: Array, points: Array) -> Array:
        """World points (n, 3), seen from the camera as it was at ``before``, where it sees them now."""
        local = (points - before[:3, 3]) @ before[:3, :3]
        return self.scale * local @ self.world_from_camera[:3, :3].T + self.world_from_camera[:3, 3]


Moved = dict[int, Similarity]  # keyframes


def spread(
    world: GlobalMap, loop: Loop, earlier: list[tuple[int, int]]
) -> tuple[Moved, float | None] | None:
    """Where each keyframe belongs once ``loop`` holds; None where the solver fails.

    The first keyframe is held, and the map keeps its unit on the whole: the scale that everybody uses stays
    right. ``earlier`` are pairs that past loops joined. Keyframes that hang together with neither end stay
    out. Where no edges lead from one end to the other the newer side moves as one; where they share no point
    either, or the tracker has them in two parts of the map, the older one's unit is kept. Then the second of
    what is returned is the log of the newer one's unit in it, else None.
    """
    if not (np.isfinite(loop.world_from_query).all() and np.isfinite(loop.scale) and loop.scale > 0):
        return None
    edges = with_bridges(world, covisibility(world, earlier))
    part = reachable(edges, {loop.query, loop.candidate})
    values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for k in part:
        values.insert(X(k), _similarity(world.keyframes[k].world_from_camera, 1.0))
    depths = {k: median_depth(world, world.keyframes[k]) for k in part}
    for (a, b), shared in edges.items():
        if a in part and b in part:
            relative = inverse(world.keyframes[a].world_from_camera) @ world.keyframes[b].world_from_camera
            noise = _noise(depths[a], max(100.0 / shared, 0.25) ** 0.5)
            graph.add(gtsam.BetweenFactorSimilarity3(X(a), X(b), _similarity(relative, 1.0), noise))
    measured = inverse(world.keyframes[loop.candidate].world_from_camera) @ loop.world_from_query
    graph.add(
        gtsam.BetweenFactorSimilarity3(
            X(loop.candidate),
            X(loop.query),
            _similarity(measured, loop.scale),
            _noise_of(loop, depths[loop.candidate]),
        )
    )
    sides = [reachable(edges, {end}) for end in (loop.candidate, loop.query)]
    told = [of for end in (loop.candidate, loop.query) if (of := world.keyframes[end].part) is not None]
    home, apart = part, False
    if sides[0] != part:
        differ = len(set(told)) == 2
        # The tracker keeps the older part too. Where nobody tells them apart, what begins first stays.
        home = sides[told.index(min(told))] if differ else min(sides, key=min)
        apart = differ or loop.candidate not in hanging_together(world, loop.query)
    held = min(home)
    tight = gtsam.noiseModel.Isotropic.Sigma(7, 1e-6)
    graph.add(
        gtsam.PriorFactorSimilarity3(
            X(held), _similarity(world.keyframes[held].world_from_camera, 1.0), tight
        )
    )
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(ITERATIONS)
    parameters.setRelativeErrorTol(CONVERGED)
    if home != part:  # one motion from where it was, however far
        _carry(world, values, part - home, loop)
    try:
        result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    except RuntimeError:
        return None
    found = {k: _pose_and_scale(result.atSimilarity3(X(k))) for k in sorted(part)}
    unit = _unit(found, home if apart else part)
    log_unit = math.log(_unit(found, part - home) / unit) if apart else None
    anchor = world.keyframes[held].world_from_camera[:3, 3]
    out: Moved = {}
    for k, (pose, scale) in found.items():
        centre = anchor + (pose[:3, 3] - anchor) / unit
        own_unit = math.exp(log_unit) if log_unit is not None and k not in home else 1.0
        out[k] = Similarity(normalised(from_rt(pose[:3, :3], centre)), scale / unit, own_unit)
    sound = all(np.isfinite(s.world_from_camera).all() and 0.1 < s.scale < 10.0 for s in out.values())
    return (out, log_unit) if sound else None


def _unit(found: dict[int, tuple[Array, float]], keyframes: set[int]) -> float:
    """How much longer their lengths have become, on the median."""
    return float(np.exp(np.median([np.log(found[k][1]) for k in keyframes])))


def apply(world: GlobalMap, moved: Moved) -> None:
    """Move keyframes, the points that they see (by the first that does), and what hangs on them; with their
    depths: a network's to where they agree as before, measured ones into the unit that is theirs now.
    """
    before = {k: world.keyframes[k].world_from_camera for k in moved}
    owned: dict[int, list[int]] = {}
    for p, point in world.points.items():
        viewers = [k for k in point.keyframes if k in moved]
        if viewers:
            owned.setdefault(min(viewers), []).append(p)
    for k, similarity in moved.items():
        mine = owned.get(k, [])
        if mine:
            places = similarity.move(before[k], np.array([world.points[p].position for p in mine]))
            for p, place in zip(mine, places, strict=True):
                world.points[p].position = place
        keyframe = world.keyframes[k]
        keyframe.world_from_camera = similarity.world_from_camera
        keyframe.grown *= similarity.unit
        world.carried.stretch(k, similarity.scale)
        if keyframe.depths is not None:
            factor = similarity.unit if keyframe.depth_sigma > 0 else similarity.scale
            keyframe.depths = keyframe.depths * factor
            keyframe.depth_units *= factor
    take_references(world)


def _carry(world: GlobalMap, values: gtsam.Values, part: set[int], loop: Loop) -> None:
    """Start a part where the loop puts it as a whole."""
    query = world.keyframes[loop.query].world_from_camera
    turn = loop.world_from_query[:3, :3] @ query[:3, :3].T
    old, new, scale = query[:3, 3], loop.world_from_query[:3, 3], loop.scale
    if loop.query not in part:  # it is the candidate's that moves
        turn, old, new, scale = turn.T, new, old, 1.0 / scale
    for k in part:
        pose = world.keyframes[k].world_from_camera
        centre = scale * turn @ (pose[:3, 3] - old) + new
        values.update(X(k), _similarity(from_rt(turn @ pose[:3, :3], centre), scale))


def _similarity(pose: Array, scale: float) -> gtsam.Similarity3:
    """gtsam's similarity is scale * (R p + t)."""
    return gtsam.Similarity3(gtsam.Rot3(pose[:3, :3]), pose[:3, 3] / scale, scale)


def _pose_and_scale(similarity: gtsam.Similarity3) -> tuple[Array, float]:
    scale = float(similarity.scale())
    return from_rt(similarity.rotation().matrix(), scale * np.asarray(similarity.translation())), scale


def _noise_of(loop: Loop, depth: float) -> gtsam.noiseModel.Base:
    """A loop's: what its points leave open, and as much as any."""
    usual = _noise(depth, LOOP_SHARE, loop.log_scale_sigma)
    if loop.information is None:
        return usual
    order = [3, 4, 5, 0, 1, 2]  # gtsam's: rotation first; lengths in the query's unit
    unit = np.repeat([1.0, 1.0 / loop.scale], 3)
    covariance = np.diag(np.square(usual.sigmas()))
    covariance[:6, :6] += doubt(loop.information, depth)[np.ix_(order, order)] * np.outer(unit, unit)
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def _noise(
    depth: float, factor: float, log_scale_sigma: float | None = None
) -> gtsam.noiseModel.Diagonal:
    stretch = STRETCH * factor if log_scale_sigma is None else max(log_scale_sigma, 0.1 * STRETCH)
    return gtsam.noiseModel.Diagonal.Sigmas(
        np.array([TURN * factor] * 3 + [SHIFT * depth * factor] * 3 + [stretch])
    )
