"""A few keyframes adjusted: against gtsam on the same problem, numerical derivatives, and known places."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from prism_edge.geometry.poses import inverse, rotation_angle, se3_exp, transform
from prism_edge.tracking import local_adjustment
from prism_edge.tracking.local_adjustment import Problem, adjust
from prism_edge.tracking.pose_refinement import HUBER
from tests.tracking.cloud import pose_at

VIEWS, FREE_VIEWS, POINTS, FREE_POINTS = 6, 4, 60, 40
FOCAL = np.array([500.0, 440.0])


def scene(seed: int = 0, noise: float = 0.0) -> tuple[Problem, np.ndarray, np.ndarray]:
    """Views side by side, all of which see all points, with ``noise`` pixels; true poses and places."""
    rng = np.random.default_rng(seed)
    poses = np.array([pose_at(*rng.normal(0.0, (0.4, 0.3, 0.2, 0.05, 0.05, 0.05))) for _ in range(VIEWS)])
    depth = rng.uniform(2.0, 6.0, POINTS)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (POINTS, 2)) * depth[:, None], depth])
    view, point = (grid.ravel() for grid in np.meshgrid(np.arange(VIEWS), np.arange(POINTS), indexing="ij"))
    local = np.concatenate([transform(inverse(pose), points) for pose in poses])
    rays = local[:, :2] / local[:, 2:] + rng.normal(0.0, noise, (len(local), 2)) / FOCAL
    nothing = np.zeros(len(view))
    return (
        Problem(
            FREE_VIEWS, FREE_POINTS, view, point, rays, np.tile(FOCAL, (len(view), 1)), np.ones(len(view)),
            np.zeros((POINTS, 3)), nothing, nothing,
        ),
        poses,
        points,
    )  # fmt: skip


def displaced(
    poses: np.ndarray, points: np.ndarray, seed: int = 1, by: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """What is free, a few centimetres and a degree away."""
    rng = np.random.default_rng(seed)
    poses, points = poses.copy(), points.copy()
    for i in range(FREE_VIEWS):
        poses[i] = poses[i] @ se3_exp(by * rng.normal(0.0, (0.03, 0.03, 0.03, 0.01, 0.01, 0.01)))
    points[:FREE_POINTS] += by * rng.normal(0.0, 0.05, (FREE_POINTS, 3))
    return poses, points


def off(found: np.ndarray, poses: np.ndarray) -> tuple[float, float]:
    """The largest errors, m and rad."""
    between = [inverse(a) @ b for a, b in zip(found, poses, strict=True)]
    return (
        max(float(np.linalg.norm(m[:3, 3])) for m in between),
        max(rotation_angle(m[:3, :3]) for m in between),
    )


@pytest.mark.parametrize("seed", range(4))
def test_what_was_displaced_comes_back(seed: int) -> None:
    problem, poses, points = scene(seed)
    found = adjust(problem, *displaced(poses, points, seed + 10))
    assert found is not None
    shift, turn = off(found[0], poses)
    assert shift < 1e-4
    assert turn < 1e-4
    assert np.abs(found[1] - points).max() < 1e-3


def test_poses_alone_come_back_where_no_point_is_free() -> None:
    problem, poses, points = scene()
    start, _ = displaced(poses, points)
    found = adjust(replace(problem, free_points=0), start, points)
    assert found is not None
    assert max(off(found[0], poses)) < 1e-6
    assert np.array_equal(found[1], points)


def test_what_is_held_stays() -> None:
    problem, poses, points = scene()
    start = displaced(poses, points)
    found = adjust(problem, *start)
    assert found is not None
    assert np.array_equal(found[0][FREE_VIEWS:], start[0][FREE_VIEWS:])
    assert np.array_equal(found[1][FREE_POINTS:], start[1][FREE_POINTS:])


def by_gtsam(problem: Problem, poses: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same problem, without network depth, as gtsam solves it."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    still = gtsam.noiseModel.Constrained.All(6), gtsam.noiseModel.Constrained.All(3)
    for i, pose in enumerate(poses):
        values.insert(X(i), gtsam.Pose3(pose))
        if i >= problem.free_views:
            graph.add(gtsam.PriorFactorPose3(X(i), gtsam.Pose3(pose), still[0]))
    for j, place in enumerate(points):
        values.insert(L(j), place)
        if j >= problem.free_points:
            graph.add(gtsam.PriorFactorPoint3(L(j), place, still[1]))
    kernel = gtsam.noiseModel.mEstimator.Huber.Create(float(local_adjustment.HUBER))
    pixel = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(2, 1.0))
    lens = gtsam.Cal3_S2(*FOCAL, 0.0, 0.0, 0.0)
    for i, j, ray in zip(problem.view, problem.point, problem.rays, strict=True):
        graph.add(gtsam.GenericProjectionFactorCal3_S2(ray * FOCAL, pixel, X(i), L(j), lens))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    return (
        np.array([result.atPose3(X(i)).matrix() for i in range(len(poses))]),
        np.array([result.atPoint3(L(j)) for j in range(len(points))]),
    )


def test_gtsam_finds_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local_adjustment, "STEPS", 30)
    monkeypatch.setattr(local_adjustment, "SETTLED", 1e-12)
    problem, poses, points = scene(3, noise=1.0)
    wrong = np.random.default_rng(5).choice(len(problem.rays), 20, replace=False)
    problem.rays[wrong] += 30.0 / FOCAL  # the kernel has work to do
    start = displaced(poses, points)
    found, there = adjust(problem, *start), by_gtsam(problem, *start)
    assert found is not None
    shift, turn = off(found[0], there[0])
    assert shift < 1e-4
    assert turn < 1e-4
    assert np.median(np.abs(found[1] - there[1])) < 1e-4


@pytest.mark.parametrize("what", ["pixels", "depth"])
def test_the_derivatives_are_those_of_the_cost(what: str) -> None:
    problem, poses, points = scene(2, noise=3.0)
    rng = np.random.default_rng(4)
    if what == "depth":
        says = rng.normal(1.2, 0.3, len(problem.view))
        problem = replace(problem, log_depth=says, depth_weight=rng.uniform(0.5, 2.0, len(says)))
    here = displaced(poses, points)
    at = local_adjustment.linearise(problem, *here)

    def cost(twist: np.ndarray, shift: np.ndarray) -> float:
        moved, shifted = here[0].copy(), here[1].copy()
        moved[1] = moved[1] @ se3_exp(twist)
        shifted[5] += shift
        return local_adjustment.linearise(problem, moved, shifted).cost

    mine, of_point = problem.view == 1, problem.point == 5
    by_twist = 2.0 * np.einsum("mki,mk->i", at.by_twist[mine], at.residual[mine])
    by_point = 2.0 * np.einsum("mki,mk->i", at.by_point[of_point], at.residual[of_point])
    for i in range(6):
        step = 1e-6 * np.eye(6)[i]
        slope = (cost(step, np.zeros(3)) - cost(-step, np.zeros(3))) / 2e-6
        assert slope == pytest.approx(by_twist[i], rel=1e-4, abs=1e-2)
    for i in range(3):
        step = 1e-6 * np.eye(3)[i]
        slope = (cost(np.zeros(6), step) - cost(np.zeros(6), -step)) / 2e-6
        assert slope == pytest.approx(by_point[i], rel=1e-4, abs=1e-2)


def test_a_doubtful_depth_makes_a_pixel_doubtful_along_what_it_moves_it() -> None:
    """The cost in explicit matrices: noise of one sigma, and what the error of the depth adds to it."""
    problem, poses, points = scene(2, noise=3.0)
    doubt = np.random.default_rng(5).normal(0.0, 0.02, points.shape)
    poses, points = displaced(poses, points, by=0.2)
    cost = 0.0
    for view, point, ray in zip(problem.view, problem.point, problem.rays, strict=True):
        places = points[point] + np.outer([0.0, 1e-6, -1e-6], doubt[point])
        here, ahead, behind = transform(inverse(poses[view]), places)
        smear = FOCAL * (ahead[:2] / ahead[2] - behind[:2] / behind[2]) / 2e-6
        error = FOCAL * (here[:2] / here[2] - ray)
        chi = np.sqrt(error @ np.linalg.inv(np.eye(2) + np.outer(smear, smear)) @ error)
        cost += chi**2 if chi < HUBER else HUBER * (2.0 * chi - HUBER)
    found = local_adjustment.linearise(replace(problem, depth_error=doubt), poses, points).cost
    assert found == pytest.approx(cost, rel=1e-6)
    assert found < 0.9 * local_adjustment.linearise(problem, poses, points).cost


def test_a_pixel_says_less_of_pose_and_point_along_what_a_doubtful_depth_moves_it() -> None:
    """Their information in explicit matrices, where all fits and no kernel counts."""
    problem, poses, points = scene(2)
    doubt = np.random.default_rng(5).normal(0.0, 0.02, points.shape)
    sure = local_adjustment.linearise(problem, poses, points)
    doubtful = local_adjustment.linearise(replace(problem, depth_error=doubt), poses, points)
    for i, point in enumerate(problem.point):
        smear = sure.by_point[i, :2] @ doubt[point]
        known = np.linalg.inv(np.eye(2) + np.outer(smear, smear))
        for its, had in ((doubtful.by_twist, sure.by_twist), (doubtful.by_point, sure.by_point)):
            assert its[i, :2].T @ its[i, :2] == pytest.approx(had[i, :2].T @ known @ had[i, :2], rel=1e-6)


def test_a_point_behind_a_camera_fits_no_pixel_there() -> None:
    """Mirrored at the camera's centre it is on the very ray: that costs much, and pulls at nothing."""
    problem, poses, points = scene()
    mine = np.where(problem.view == 0, 1.0, 0.0)
    depths = np.log(transform(inverse(poses[0]), points)[problem.point, 2])
    problem = replace(problem, weight=mine, depth_weight=mine, log_depth=depths)
    points[0] = 2.0 * poses[0, :3, 3] - points[0]
    at = local_adjustment.linearise(problem, poses, points)
    there = (problem.view == 0) & (problem.point == 0)
    for column in (at.residual, at.by_twist, at.by_point):
        assert not column[there].any()
    assert at.cost == pytest.approx(HUBER * (2.0 * local_adjustment.BEHIND - HUBER))


def one_held(says: float, sigma: float) -> tuple[Problem, np.ndarray, np.ndarray]:
    """All points free and one view held, so that rays leave the size open; the network finds all larger."""
    problem, poses, points = scene()
    order = np.r_[1:VIEWS, 0]  # the held one last
    poses = poses[order]
    view = np.argsort(order)[problem.view]
    local = np.einsum("nji,nj->ni", poses[view, :3, :3], points[problem.point] - poses[view, :3, 3])
    weight = np.full(len(view), 1.0 / (sigma * np.sqrt(POINTS)) if sigma else 0.0)
    return (
        replace(
            problem, free_views=VIEWS - 1, free_points=POINTS, view=view,
            log_depth=np.log(local[:, 2]) + says, depth_weight=weight,
        ),
        poses,
        points,
    )  # fmt: skip


def size(poses: np.ndarray, points: np.ndarray) -> float:
    """Log of how large the whole is, about the held view."""
    return float(np.log(np.median(np.linalg.norm(points - poses[-1, :3, 3], axis=1))))


@pytest.mark.parametrize("says", [0.1, -0.1])
def test_the_size_is_the_networks_where_rays_leave_it_open(
    says: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local_adjustment, "STEPS", 30)
    monkeypatch.setattr(local_adjustment, "SETTLED", 1e-9)
    problem, poses, points = one_held(says, sigma=0.15)
    found = adjust(problem, poses, points)
    assert found is not None
    assert size(*found) - size(poses, points) == pytest.approx(says, abs=0.01)
    shape = [np.linalg.norm(p - p[0], axis=1)[1:] for p in (found[1], points)]
    assert np.std(np.log(shape[0] / shape[1])) < 0.01, "one size for all"
    problem, *_ = one_held(says, sigma=0.0)
    assert adjust(problem, poses, points) is None, "nothing said"


def test_one_images_vote_is_one_vote() -> None:
    """Held well, a wrong vote of three sigmas moves next to nothing."""
    problem, poses, points = scene()
    local = np.einsum(
        "nji,nj->ni", poses[problem.view, :3, :3], points[problem.point] - poses[problem.view, :3, 3]
    )
    vote = np.full(len(problem.view), 1.0 / (0.15 * np.sqrt(POINTS)))
    problem = replace(problem, log_depth=np.log(local[:, 2]) + 0.45, depth_weight=vote)
    found = adjust(problem, *displaced(poses, points))
    assert found is not None
    assert off(found[0], poses)[0] < 0.01


def test_a_gross_error_is_hardly_heard() -> None:
    problem, poses, points = scene()
    problem.rays[::40] += 200.0 / FOCAL
    found = adjust(problem, *displaced(poses, points))
    assert found is not None
    assert off(found[0], poses)[0] < 0.01


def test_a_doubtful_held_point_turns_no_view() -> None:
    """Held points at wrong depths, said to be doubtful by as much, leave the poses nearly as they were."""
    problem, poses, points = scene()
    wrong = points.copy()
    first = points - poses[-1, :3, 3]
    wrong[FREE_POINTS:] += 0.3 * first[FREE_POINTS:]
    doubt = np.zeros((POINTS, 3))
    doubt[FREE_POINTS:] = 0.3 * first[FREE_POINTS:]
    sure = adjust(problem, poses, wrong)
    unsure = adjust(replace(problem, depth_error=doubt), poses, wrong)
    assert sure is not None
    moved = 0.0 if unsure is None else off(unsure[0], poses)[0]
    assert moved < 0.5 * off(sure[0], poses)[0]


def test_a_step_that_makes_it_worse_is_not_taken_and_the_next_is_a_shorter_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, poses, points = scene(noise=1.0)
    begun = displaced(poses, points)
    step_from, damped, costs = local_adjustment.gauss_newton, list[float](), list[float]()

    def overshoots_once(
        problem: Problem, at: local_adjustment.Linear, damping: float
    ) -> local_adjustment.Step:
        step = step_from(problem, at, damping)
        damped.append(damping)
        costs.append(at.cost)
        if len(damped) > 1:
            return step
        return replace(step, twists=-3.0 * step.twists, shifts=-3.0 * step.shifts)

    monkeypatch.setattr(local_adjustment, "gauss_newton", overshoots_once)
    assert adjust(problem, *begun) is not None
    assert damped[1] > 10.0 * damped[0]
    assert costs[1] == costs[0] > costs[2]


def test_what_fits_is_left_alone() -> None:
    problem, poses, points = scene()
    assert adjust(problem, poses, points) is None


@pytest.mark.parametrize("broken", ["behind", "alike", "nothing weighs"])
def test_a_hopeless_problem_yields_finite_numbers_or_none(broken: str) -> None:
    problem, poses, points = scene()
    poses, points = displaced(poses, points)
    if broken == "behind":
        points[:FREE_POINTS] *= -1.0
    elif broken == "alike":
        poses[:] = poses[0]
        points[:] = points[0]
    else:
        problem = replace(problem, weight=np.zeros(len(problem.view)))
    found = adjust(problem, poses, points)
    assert found is None or all(np.isfinite(x).all() for x in found)
