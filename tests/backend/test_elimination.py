"""The order of elimination changes what a solution costs, not what it is."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from prism_edge.backend import elimination
from prism_edge.backend.elimination import ONE_BY_ONE, covariance_of_last, points_first, solver
from prism_edge.backend.factors import held
from prism_edge.backend.lens import ALIKE, LENS, found
from prism_edge.geometry.cameras import Camera
from tests.tracking.cloud import CAMERA, Cloud, pose_at

POSES = [pose_at(0.3 * i, 0.1 * i, 0.0, 0.0, -0.05 * i) for i in range(5)]
POINTS = range(60)


def problem(with_lens: bool) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Five views of sixty points, half a pixel of noise, poses and points a little off."""
    rng, cloud = np.random.default_rng(2), Cloud(len(POINTS))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 0.5)
    calibration = gtsam.Cal3_S2(CAMERA.fx, CAMERA.fy, 0.0, CAMERA.cx, CAMERA.cy)
    for k, pose in enumerate(POSES):
        start = gtsam.Pose3(pose)
        values.insert(X(k), start if k in (0, 4) else start.retract(0.01 * rng.normal(size=6)))
        local = (cloud.positions - pose[:3, 3]) @ pose[:3, :3]
        for p, pixel in enumerate(CAMERA.project(local)):
            seen = pixel + 0.5 * rng.normal(size=2)
            if with_lens:
                bundler = seen - (CAMERA.cx, CAMERA.cy)
                graph.add(gtsam.GeneralSFMFactor2Cal3Bundler(bundler, noise, X(k), L(p), LENS))
            else:
                graph.add(gtsam.GenericProjectionFactorCal3_S2(seen, noise, X(k), L(p), calibration))
    for k in (0, 4):
        graph.add(held(X(k), POSES[k]))
    for p in POINTS:
        values.insert(L(p), cloud.positions[p] + 0.01 * rng.normal(size=3))
    if with_lens:
        start = gtsam.Cal3Bundler(CAMERA.fx, 0.0, 0.0, 0.0, 0.0)
        values.insert(LENS, start)
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e-6 * CAMERA.fx, 0.1, 1e-6]))
        graph.add(gtsam.PriorFactorCal3Bundler(LENS, start, sigmas))
    return graph, values


@pytest.mark.parametrize("one_by_one", [0, ONE_BY_ONE])
@pytest.mark.parametrize("with_lens", [False, True])
def test_the_solution_is_gtsam_s_own(monkeypatch, one_by_one, with_lens):
    monkeypatch.setattr(elimination, "ONE_BY_ONE", one_by_one)
    graph, values = problem(with_lens)
    ordering = points_first(POINTS, range(len(POSES)), [LENS] if with_lens else [])
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, solver(ordering, len(POSES))).optimize()
    own = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    assert graph.error(solved) < 0.2 * graph.error(values)
    assert graph.error(solved) == pytest.approx(graph.error(own), rel=1e-4)
    for k in range(len(POSES)):
        assert solved.atPose3(X(k)).matrix() == pytest.approx(own.atPose3(X(k)).matrix(), abs=1e-3)


def test_the_variance_of_what_comes_last_is_its_marginal():
    graph, values = problem(with_lens=True)
    ordering = points_first(POINTS, range(len(POSES)), [LENS])
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, solver(ordering, len(POSES))).optimize()
    was = Camera(CAMERA.width, CAMERA.height, CAMERA.fx, CAMERA.fx, CAMERA.cx, CAMERA.cy)
    lens = found(graph, solved, ordering, was, 0.0)
    marginal = gtsam.Marginals(graph, solved).marginalCovariance(LENS)[1, 1]
    assert lens is not None
    assert (lens.sigma / ALIKE) ** 2 == pytest.approx(marginal, rel=1e-3)


def test_what_hangs_together_within_what_comes_last_is_in_its_covariance():
    """A pose whose turn and way go together, as before points all on one side."""
    graph, values = problem(with_lens=False)
    ordering = points_first(POINTS, range(len(POSES)))
    graph.remove(graph.size() - 1)  # the last pose is free now, but for the unit
    loose = gtsam.noiseModel.Isotropic.Sigma(6, 0.05)
    graph.add(gtsam.PriorFactorPose3(X(4), gtsam.Pose3(POSES[4]), loose))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, solver(ordering, len(POSES))).optimize()
    marginal = gtsam.Marginals(graph, solved).marginalCovariance(X(4))
    assert covariance_of_last(graph, solved, ordering) == pytest.approx(marginal, rel=1e-3, abs=1e-12)


def test_where_only_small_steps_lead_down_a_heavy_error_is_damped_until_they_are_taken():
    """Newton's step on the arctangent at 3 goes past 0 to -9, from where it would go farther and farther."""
    weight = 1e5

    def error(this: gtsam.CustomFactor, values: gtsam.Values, slopes: list | None) -> np.ndarray:
        x = values.atVector(this.keys()[0])
        if slopes is not None:
            slopes[0] = np.array([[weight / (1.0 + x[0] ** 2)]])
        return weight * np.arctan(x)

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [X(0)], error))
    values.insert(X(0), np.array([3.0]))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, solver(points_first([], [0]), 1)).optimize()
    assert solved.atVector(X(0)) == pytest.approx([0.0], abs=1e-4)


@pytest.mark.parametrize(("poses", "one_by_one"), [(12, True), (ONE_BY_ONE, True), (ONE_BY_ONE + 1, False)])
def test_few_poses_are_eliminated_one_by_one_and_all_in_the_order_that_is_given(poses, one_by_one):
    """As gtsam understands it; a solution says nothing of what it cost."""
    parameters = solver(points_first(POINTS, range(poses)), poses)
    assert (parameters.isSequential(), parameters.isMultifrontal()) == (one_by_one, not one_by_one)
    assert parameters.getOrderingType() == "CUSTOM"
