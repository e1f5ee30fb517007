"""Poses that a window holds: no variables, and as firm as under a prior."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from prism_edge.backend import settling
from prism_edge.backend import window as module
from prism_edge.backend.factors import held
from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.window import Window, choose_window, placed_elsewhere
from prism_edge.geometry.poses import inverse, se3_log
from tests.backend.test_window import CONFIG, perturb, world_of
from tests.tracking.cloud import pose_at


def variables(world: GlobalMap, window: Window) -> set[int]:
    """The keyframes of a window whose poses are variables of its graph."""
    values = module.assemble(world, window, CONFIG, 1.0, use_depth=True, use_rays=True).values
    return {k for k in (*window.free, *window.held) if values.exists(X(k))}


def test_poses_that_are_held_are_no_variables_but_where_depth_is_a_factor_of_them() -> None:
    world, _ = world_of([pose_at(0.2 * i) for i in range(9)])
    several = Window([5, 6, 7, 8], [1, 2, 3], sorted(world.points))
    assert variables(world, several) == set(several.free)
    alone = Window([1, 2, 3], [0], sorted(world.points))
    assert variables(world, alone) == {0, 1, 2, 3}, "scale rests on depth, which the held one has, too"
    world.keyframes[2].depth_sigma = 0.05
    assert variables(world, several) == {*several.free, *several.held}, "a sensor's depth"


@pytest.mark.parametrize("sensor", [True, False])
def test_where_several_poses_are_held_only_a_sensor_s_depth_is_a_factor(sensor: bool) -> None:
    """Of the free ones, too; a network's would draw far points in."""
    world, _ = world_of([pose_at(0.2 * i) for i in range(9)])
    several = Window([5, 6, 7, 8], [1, 2, 3], sorted(world.points))
    for k in several.free:
        world.keyframes[k].depth_sigma = 0.05 if sensor else 0.0
    graph = module.assemble(world, several, CONFIG, 1.0, use_depth=True, use_rays=True).graph
    kinds = [type(graph.at(i)).__name__ for i in range(graph.size())]
    seen = sum(len(world.keyframes[k].observed) for k in several.free)
    assert sum("RangeFactor" in kind for kind in kinds) == (seen if sensor else 0)


@pytest.mark.parametrize("shallow", [False, True])
def test_a_known_pose_holds_as_one_under_a_prior_does(shallow: bool) -> None:
    """Reprojections and, of points with little parallax, rays, beside the same graph with all poses in it."""
    world, _ = world_of([pose_at(0.2 * i, 0.02 * (i % 3)) for i in range(9)], noise_px=0.5)
    perturb(world, seed=3, pose_sigma=0.005, point_sigma=0.02)
    for p, point in world.points.items():
        point.parallax_deg = 1.0 if shallow and p % 2 else 10.0
    window = choose_window(world, 8, replace(CONFIG, window=5, fixed=4))
    assert len(window.held) > 1
    problem = module.assemble(world, window, CONFIG, 1.0, use_depth=True, use_rays=True)
    assert bool(problem.rays) == shallow
    graph, values, make = gtsam.NonlinearFactorGraph(), gtsam.Values(problem.values), problem.factors
    rays = {(ray.keyframe, ray.point) for ray in problem.rays}
    for k in window.held:
        values.insert(X(k), gtsam.Pose3(world.keyframes[k].world_from_camera))
        graph.add(held(X(k), world.keyframes[k].world_from_camera))
    for k, p, keypoint in problem.observations:
        keyframe = world.keyframes[k]
        if (k, p) in rays:
            distance = float(np.linalg.norm(world.points[p].position - keyframe.world_from_camera[:3, 3]))
            graph.add(make.ray(X(k), L(p), keyframe, keypoint, distance))
        else:
            graph.add(make.reprojection(X(k), L(p), keyframe, keypoint))
    for p in placed_elsewhere(world, window):
        graph.add(gtsam.PriorFactorPoint3(L(p), world.points[p].position, module.HELD_POINT))
    at = {k: keyframe.world_from_camera[:3, 3] for k, keyframe in world.keyframes.items()}
    away = [np.linalg.norm(world.points[ray.point].position - at[ray.keyframe]) for ray in problem.rays]
    assert settling.ranges_of(problem, problem.values) == pytest.approx(away) if shallow else not away
    known = settling.with_rays(world, problem, problem.values)
    assert known.error(problem.values) == pytest.approx(graph.error(values), rel=1e-4)
    both = (known, problem.values), (graph, values)
    one, other = (gtsam.LevenbergMarquardtOptimizer(*each).optimize() for each in both)
    for k in window.free:
        apart = inverse(one.atPose3(X(k)).matrix()) @ other.atPose3(X(k)).matrix()
        assert np.abs(se3_log(apart)).max() < 1e-4
