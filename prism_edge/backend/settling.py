"""A window's factors as gtsam has them, and how they are solved from a start."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from prism_edge.backend.elimination import points_first, solver
from prism_edge.backend.factors import FactorFactory
from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap
from prism_edge.geometry.poses import Array

REFINING = 4  # iterations kept for a second round
RANGE_CHANGE = 0.05
CONVERGED = 1e-4  # relative decrease of the cost that is not worth another iteration


@dataclass(frozen=True)
class Ray:
    """An observation that counts as a ray: its noise goes with the point's range, which moves."""

    keyframe: int
    point: int
    keypoint: int


@dataclass
class WindowProblem:
    """A window as gtsam has it. ``rays`` are not in ``graph``: each round makes them anew.

    ``standing`` are the keyframes whose poses are no variables: what they see are factors of points alone,
    which leaves less to eliminate.
    """

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    observations: list[tuple[int, int, int]]  # keyframe, point, keypoint
    rays: list[Ray]
    factors: FactorFactory
    standing: dict[int, GlobalKeyframe]
    variables: list[int]  # the other keyframes
    points: list[int]
    pinned: set[int]  # points that stay where they are
    unit_is_free: bool = False  # nothing says how large all of it is


@dataclass(frozen=True)
class Settled:
    """Where a solver has come to."""

    values: gtsam.Values
    iterations: int


def settle(world: GlobalMap, problem: WindowProblem, start: gtsam.Values, iterations: int) -> Settled | None:
    """Levenberg-Marquardt from a start; None where gtsam fails."""
    parameters = solver(points_first(problem.points, problem.variables), len(problem.variables))
    parameters.setRelativeErrorTol(1e-4)
    result, done = start, 0
    first = max(iterations - REFINING, 1) if problem.rays else iterations
    try:
        for most in (first, iterations):
            started, converged = result, False
            graph = with_rays(world, problem, result)
            optimiser = gtsam.LevenbergMarquardtOptimizer(graph, result, parameters)
            previous = optimiser.error()
            # Step by step, so that the interpreter breathes between iterations.
            while done < most:
                optimiser.iterate()
                done += 1
                error = optimiser.error()
                converged = previous - error < CONVERGED * previous
                if converged:
                    break
                previous = error
            result = optimiser.values()
            # Rays are whitened by ranges: where those have changed a second round sets that right.
            if converged and not stale(problem, started, result):
                break
    except RuntimeError:
        return None
    return Settled(result, done)


def costs_of(
    world: GlobalMap, problem: WindowProblem, one: gtsam.Values, other: gtsam.Values
) -> tuple[float, float]:
    """What two solutions cost (nats), rays whitened by both's ranges: by its own a near one has less."""
    graphs = with_rays(world, problem, one), with_rays(world, problem, other)
    before, after = (sum(graph.error(values) for graph in graphs) / 2 for values in (one, other))
    return float(before), float(after)


def with_rays(world: GlobalMap, problem: WindowProblem, values: gtsam.Values) -> gtsam.NonlinearFactorGraph:
    """The problem's graph with its ray factors, whitened by the ranges that ``values`` have."""
    if not problem.rays:
        return problem.graph
    graph, make = gtsam.NonlinearFactorGraph(problem.graph), problem.factors
    for ray, distance in zip(problem.rays, ranges_of(problem, values).tolist(), strict=True):
        k, point_key, keypoint = ray.keyframe, L(ray.point), ray.keypoint
        if k in problem.standing:
            graph.add(make.ray_from(point_key, world.keyframes[k], keypoint, distance))
        else:
            graph.add(make.ray(X(k), point_key, world.keyframes[k], keypoint, distance))
    return graph


def stale(problem: WindowProblem, whitened_at: gtsam.Values, now: gtsam.Values) -> bool:
    """Whether a tenth of the rays or more has a range that differs by more than RANGE_CHANGE (log)."""
    if not problem.rays:
        return False
    before, after = ranges_of(problem, whitened_at), ranges_of(problem, now)
    return bool(np.mean(np.abs(np.log(before / after)) > RANGE_CHANGE) > 0.1)


def ranges_of(problem: WindowProblem, values: gtsam.Values) -> Array:
    """Distance (n,) of each ray's point from its camera."""
    cameras = {ray.keyframe for ray in problem.rays}
    centres = {k: keyframe.world_from_camera[:3, 3] for k, keyframe in problem.standing.items()}
    centres |= {k: values.atPose3(X(k)).translation() for k in cameras - centres.keys()}
    points = {p: values.atPoint3(L(p)) for p in {ray.point for ray in problem.rays}}
    offsets = np.array([points[ray.point] - centres[ray.keyframe] for ray in problem.rays])
    return np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
