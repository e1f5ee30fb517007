"""Bundle adjustment of a window of keyframes (paper, section 3.4; W = 12, 15 iterations)."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from itertools import chain

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from prism_edge.backend.factors import FactorFactory, held
from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.backend.second_start import clearly_less, is_exchanged, mirrored, of_network, second_start
from prism_edge.backend.settling import Ray, Settled, WindowProblem, costs_of, settle
from prism_edge.backend.sizes import astray, size_factors, sizes
from prism_edge.backend.ties import at_one_spot, median_range, untied
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import Array

log = logging.getLogger("prism_edge.backend")

CHI2_2D_99 = 9.21
DEPTH_PARALLAX_DEG = 3.0  # above it two rays place a point far better than a network does
IN_LENS = 0.002  # of the depth of the scene, along z: nearer there is nothing but the lens
BESIDE = 0.02  # of the depth of the scene: from one spot, for its points
STRUGGLED = 8  # iterations: of 21 second starts that were taken none came where the first took fewer
UNPLACED = 0.25  # of a point's parallax: a window that has less of it can't say how far the point is
LEAST_SAID = 20  # points that say how large a window is which one pose holds; fewer may all be wrong
HELD_POINT = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)


@dataclass(frozen=True)
class Window:
    """Which keyframes are free, which are held, and which points join them."""

    free: list[int]
    held: list[int]
    points: list[int]
    reaches_out: bool = False  # one is held, and what that one sees keyframes outside see, too


@dataclass(frozen=True)
class Solution:
    """What a solve moved, and the observations it found wrong."""

    poses: dict[int, Array]
    points: dict[int, Array]
    parallax_deg: dict[int, float]
    outliers: list[tuple[int, int]]  # keyframe, point
    iterations: int
    unit_is_free: bool = False  # nothing said how large all of it is: that is the solver's doing


def choose_window(world: GlobalMap, newest: int, config: BackendConfig) -> Window:
    """The newest keyframe, those that share most with it, and older ones that hold the gauge.

    What stands in for an older keyframe is free alone: in a room that a camera stays in, each window would
    move those that placed it by a fraction of a millimetre, and in an hour the map by centimetres.
    Exactly one pose is held while the window is the whole map: scale then rests on metric depth alone. After
    a quick turn it may be one, too, of the map that lies behind.
    """
    sharing = world.neighbours(newest)
    free = [newest, *([] if world.keyframes[newest].stands_in else sharing[: config.window - 1])]
    counts: dict[int, int] = {}
    for k in free:
        for point in world.keyframes[k].observed:
            counts[point] = counts.get(point, 0) + 1
    chosen: set[int] = set()
    for k in free:
        # Points that many of the window see tie it together best.
        mine = sorted(world.keyframes[k].observed, key=lambda p: (-counts[p], p))
        chosen.update(mine[: config.observations])
    inside = set(free)
    outside: dict[int, int] = {}
    for point in chosen:
        for k in world.points[point].keyframes - inside:
            outside[k] = outside.get(k, 0) + 1
    # Those that stand in for others last: they were placed by what they would hold.
    sharing_most = sorted(outside, key=lambda k: (world.keyframes[k].stands_in, -outside[k], k))
    ranked = [k for k in sharing_most if outside[k] >= 10]
    anchors = apart(world, free, ranked, config.fixed)
    if not anchors:
        anchors = [min(free)]
        free = [k for k in free if k not in anchors]
    members = set(free) | set(anchors)
    # Not where one of several was asked for: those that could hold it as well tie its size.
    reaches_out = len(anchors) == 1 and len(ranked) < 2
    reaches_out = reaches_out and not members.issuperset(world.neighbours(anchors[0]))
    if reaches_out:  # what is left out would stay of the size that all else has no more
        chosen.update(*(world.keyframes[k].observed for k in free))
    points = sorted(p for p in chosen if len(world.points[p].keyframes & members) >= 2)
    return Window(sorted(free), sorted(anchors), points, reaches_out)


def apart(world: GlobalMap, free: list[int], ranked: list[int], most: int) -> list[int]:
    """The first in rank that stand beside none of the free keyframes or of each other, to be held.

    Where a camera has come by a hundred times those that share most all stand in one spot, from which no
    point can be placed. If there are too few others, the rest are again the first in rank.
    """
    depth = median_range(world, free[0])
    taken = [world.keyframes[k].world_from_camera[:3, 3] for k in free]
    chosen: list[int] = []
    for k in ranked:
        if len(chosen) == most:
            break
        here = world.keyframes[k].world_from_camera[:3, 3]
        if min(np.linalg.norm(here - other) for other in taken) >= BESIDE * depth:
            chosen.append(k)
            taken.append(here)
    left = [k for k in ranked if k not in chosen]
    return chosen + left[: most - len(chosen)]


def assemble(
    world: GlobalMap,
    window: Window,
    config: BackendConfig,
    units_per_metre: float,
    use_depth: bool,
    use_rays: bool,
) -> WindowProblem:
    """Factors and starting values of a window.

    With one pose held scale rests on depth: then there is a metric depth factor wherever a keyframe has depth
    for a point, else only where that is as good as a sensor's. A network flattens what it sees, and of the
    points that rays hardly place, which are the far ones, all would be drawn nearer, and the map shrink on
    its way. Keyframes whose size nothing ties to that of those held (ties.py) have a vote each on it
    (sizes.py), and points that would give them quite another one are left to either side alone. Where those
    held all stand at one spot, on which the camera turned, the little ways between them are noise and not a
    measure: then only the first stays, and the others nearly. At a point whose rays differ by less than 3
    degrees a ray is in place of the reprojection, which would say the same.

    Where the one pose that is held is of a map behind a quick turn, that map's metres are the new ground's:
    not those of its own points, which so few others tie to the map that they may be of any size.
    """
    graph, values, observations, rays = gtsam.NonlinearFactorGraph(), gtsam.Values(), [], []
    factors = FactorFactory(config, units_per_metre)
    members = {k: (X(k), world.keyframes[k]) for k in window.free + window.held}
    if window.reaches_out:
        members = {k: (key, _laid_by(units_per_metre, keyframe)) for k, (key, keyframe) in members.items()}
    scale_is_free = len(window.held) == 1
    measured = any(world.keyframes[k].depth_sigma > 0 for k in window.held)
    told: list[int] = []
    if use_depth and not scale_is_free:
        loose = untied(world, window.held, window.free, window.points)
        told = [k for k in loose if world.keyframes[k].depth_sigma == 0.0]
    nearly = bool(told) and at_one_spot(world, window.held)
    # To a held pose that depth is a factor of there is no way but as a variable under a prior.
    standing = {} if scale_is_free or measured or nearly else {k: world.keyframes[k] for k in window.held}
    for k, (pose_key, keyframe) in members.items():
        if k not in standing:
            values.insert(pose_key, gtsam.Pose3(keyframe.world_from_camera))
    for k in window.held if not standing else ():
        keyframe = world.keyframes[k]
        if nearly and k != window.held[0]:
            graph.add(factors.nearly_held(X(k), keyframe, median_range(world, k)))
        else:
            graph.add(held(X(k), keyframe.world_from_camera))
    log_units, shown = math.log(units_per_metre), set(window.points)
    votes = sizes(world, told, {k: sorted(world.keyframes[k].observed.keys() & shown) for k in told}, True)
    wrong = astray(world, set(told), votes, window.points, log_units)
    # What the new ground keeps alone is not to be held where the others have it.
    placed = placed_elsewhere(world, window) - {p for k, p in wrong if k not in told}
    said: set[int] = set()
    for p in window.points:
        point, point_key = world.points[p], L(p)
        values.insert(point_key, point.position)
        if p in placed:
            graph.add(gtsam.PriorFactorPoint3(point_key, point.position, HELD_POINT))
        shallow = point.parallax_deg < DEPTH_PARALLAX_DEG
        for k in point.keyframes & members.keys():
            pose_key, keyframe = members[k]
            keypoint = keyframe.observed[p]
            observations.append((k, p, keypoint))
            if (k, p) in wrong:
                continue
            deep = use_depth and keyframe.depths is not None and keyframe.depths[keypoint] > 0
            if deep and (scale_is_free or keyframe.depth_sigma > 0):
                graph.add(factors.metric_depth(pose_key, point_key, keyframe, keypoint))
                if k not in window.held and (keyframe.depth_units > 0 or keyframe.depth_sigma > 0):
                    said.add(p)
            if deep and shallow and use_rays:
                rays.append(Ray(k, p, keypoint))
            elif k in standing:
                graph.add(factors.reprojection_from(point_key, keyframe, keypoint))
            else:
                graph.add(factors.reprojection(pose_key, point_key, keyframe, keypoint))
    for factor in size_factors(votes, log_units):
        graph.add(factor)
    variables = sorted(members.keys() - standing.keys())
    is_sized = bool(placed) or (window.reaches_out and len(said) >= LEAST_SAID)
    of_any_unit = scale_is_free and not is_sized
    return WindowProblem(
        graph, values, observations, rays, factors, standing, variables, window.points, placed, of_any_unit
    )


def _laid_by(units_per_metre: float, keyframe: GlobalKeyframe) -> GlobalKeyframe:
    """The keyframe with its network's depths by one unit for all, not by that of its own points."""
    if keyframe.depths is None or keyframe.depth_units <= 0.0:
        return keyframe
    return replace(keyframe, depths=keyframe.depths * (units_per_metre / keyframe.depth_units))


def placed_elsewhere(world: GlobalMap, window: Window) -> set[int]:
    """Points that keyframes outside of the window place, and those in it can't: they stay where they are.

    Beside one pose, which leaves a window any size, only where they are enough to say it.
    """
    known = {p: world.points[p].position for p in window.points}
    known = {p: x for p, x in known.items() if world.points[p].parallax_deg >= DEPTH_PARALLAX_DEG}
    alone = len(window.held) == 1
    if not known or (alone and not window.reaches_out):
        return set()
    seen = widest_parallax(world, known, set(window.free) | set(window.held))
    placed = {p for p, angle in seen.items() if angle < UNPLACED * world.points[p].parallax_deg}
    return set() if alone and len(placed) < LEAST_SAID else placed


def solve(
    world: GlobalMap,
    window: Window,
    config: BackendConfig,
    units_per_metre: float,
    use_depth: bool,
    use_rays: bool = True,
) -> Solution | None:
    """Optimise a window; None where there is nothing to optimise or gtsam fails on it."""
    if not window.free or len(window.points) < 10:
        return None
    problem = assemble(world, window, config, units_per_metre, use_depth, use_rays)
    solved = settle(world, problem, problem.values, config.iterations)
    if solved is None:
        return None
    found, points = _places(problem, solved)
    if use_depth and len(window.held) < config.fixed:  # on new ground
        exchanged, members = is_exchanged(world, found, points), [*window.held, *window.free]
        if exchanged or solved.iterations >= STRUGGLED:
            depths = of_network(world, members, units_per_metre, as_laid=not window.reaches_out)
            solved = _or_from(depths, "depth has it", world, window, problem, config.iterations, solved)
        if exchanged:
            depths = mirrored(world, members, window.points)
            solved = _or_from(depths, "its mirror image", world, window, problem, config.iterations, solved)
        found, points = _places(problem, solved)
    if not all(np.isfinite(list(places.values())).all() for places in (found, points)):
        return None
    wrong = outliers(world, found, points, problem.observations, config)
    poses = {k: found[k] for k in window.free}
    parallax = widest_parallax(world, points, poses=poses)
    return Solution(poses, points, parallax, wrong, solved.iterations, problem.unit_is_free)


def _places(problem: WindowProblem, solved: Settled) -> tuple[dict[int, Array], dict[int, Array]]:
    """Poses (4, 4) of its keyframes and places (3,) of its points."""
    found = {k: solved.values.atPose3(X(k)).matrix() for k in problem.variables}
    return found, {p: np.asarray(solved.values.atPoint3(L(p))) for p in problem.points}


def _or_from(
    depths: dict[int, Array],
    how: str,
    world: GlobalMap,
    window: Window,
    problem: WindowProblem,
    iterations: int,
    solved: Settled,
) -> Settled:
    """What a window comes to, or where it comes from such depths if that fits clearly better."""
    start = second_start(world, window.held, window.free, window.points, problem.pinned, depths)
    if start is None:
        return solved
    values = gtsam.Values()
    for k in problem.variables:
        values.insert(X(k), gtsam.Pose3(start[0].get(k, world.keyframes[k].world_from_camera)))
    for p in window.points:
        values.insert(L(p), start[1][p])
    other = settle(world, problem, values, iterations)
    if other is None:
        return solved
    before, cost = costs_of(world, problem, solved.values, other.values)
    if not clearly_less(cost, before):
        return solved
    newest = max(window.free)
    log.info("keyframe %d: its window fits better as %s (cost %.0f to %.0f)", newest, how, before, cost)
    return other


def widest_parallax(
    world: GlobalMap,
    points: dict[int, Array],
    among: set[int] | None = None,
    poses: dict[int, Array] | None = None,
) -> dict[int, float]:
    """Angle (degrees) between the first ray of each point and the one farthest from it.

    ``among``: only from these keyframes, of which every point must be seen by one. ``poses``: of those that
    are about to move with the points.
    """
    row = {k: i for i, k in enumerate(world.keyframes)}
    at = {k: keyframe.world_from_camera for k, keyframe in world.keyframes.items()} | (poses or {})
    centres = np.array([at[k][:3, 3] for k in row])
    seen_by = (world.points[p].keyframes for p in points)
    viewers = [sorted(all_of if among is None else all_of & among) for all_of in seen_by]
    counts = np.array([len(mine) for mine in viewers])
    starts = np.cumsum(counts) - counts
    places = np.repeat(np.array(list(points.values())), counts, axis=0)
    directions = places - centres.take([row[k] for k in chain.from_iterable(viewers)], axis=0)
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    cosine = np.einsum("ij,ij->i", directions, np.repeat(directions[starts], counts, axis=0))
    angles = np.degrees(np.arccos(np.clip(np.minimum.reduceat(cosine, starts), -1.0, 1.0)))
    return dict(zip(points, angles.tolist(), strict=True))


def outliers(
    world: GlobalMap,
    poses: dict[int, Array],
    points: dict[int, Array],
    observations: list[tuple[int, int, int]],
    config: BackendConfig,
) -> list[tuple[int, int]]:
    """Observations beyond the 99 % bound of reprojection errors, or whose point is behind or in the lens.

    A point that has slipped into a lens may fit any pixel there, and any pose makes it one behind or far off
    it: it would keep all of a solve from moving.
    """
    wrong: list[tuple[int, int]] = []
    places, row = np.array(list(points.values())), {p: i for i, p in enumerate(points)}
    by_keyframe: dict[int, tuple[list[int], list[int]]] = {}
    for k, p, keypoint in observations:
        of_points, of_pixels = by_keyframe.setdefault(k, ([], []))
        of_points.append(p)
        of_pixels.append(keypoint)
    for k, (ids, keypoints) in by_keyframe.items():
        keyframe = world.keyframes[k]
        pose = poses.get(k, keyframe.world_from_camera)
        local = (places.take([row[p] for p in ids], axis=0) - pose[:3, 3]) @ pose[:3, :3]
        before = local[:, 2] > max(IN_LENS * float(np.median(local[:, 2])), 1e-6)
        z = np.where(before, local[:, 2], 1.0)
        projected = keyframe.camera.to_pixels(local[:, :2] / z[:, None])
        sigma = config.pixel_sigma * keyframe.sigmas[keypoints]
        chi2 = (((projected - keyframe.pixels[keypoints]) / sigma[:, None]) ** 2).sum(axis=1)
        wrong += [(k, ids[i]) for i in np.flatnonzero((chi2 > CHI2_2D_99) | ~before)]
    return wrong
