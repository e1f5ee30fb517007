"""Bundle adjustment of a few keyframes and the points they made, held by the map round them.

Reprojection errors under a Huber kernel, minimised by Levenberg-Marquardt. The points go first (Schur
complement), which leaves six unknowns a keyframe; all is done in columns, some ten milliseconds for eight
keyframes. What rays don't fix, how far away all is, rests on network depth: one vote an image, as what a
network says of one image is wrong together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prism_edge.geometry.poses import Array, se3_exp
from prism_edge.tracking.point_table import Index
from prism_edge.tracking.pose_refinement import HUBER

STEPS = 4
SETTLED = 1e-3  # a step that gains no larger share of the cost is the last
LEAST_DEPTH = 1e-3
BEHIND = 1e3  # what a point behind a camera counts as, sigmas
FLOOR = 1e-9  # of information: a direction that nothing measures stays where it is


@dataclass(frozen=True)
class Problem:
    """Observations (m,) of points by views. The first ``free_views`` and ``free_points`` can move."""

    free_views: int
    free_points: int
    view: Index  # (m,)
    point: Index  # (m,)
    rays: Array  # (m, 2) x and y at z = 1
    inverse_sigma: Array  # (m, 2) of those
    weight: Array  # (m,)
    depth_error: Array  # (points, 3) one sigma along the ray of a held point of doubtful depth, else 0
    log_depth: Array  # (m,) what a network says of the depth
    depth_weight: Array  # (m,) root of its information; 0 for nothing said


@dataclass(frozen=True)
class Linear:
    """A problem linearised: whitened residuals and Jacobians, three rows an observation."""

    cost: float
    residual: Array  # (m, 3) two of the pixel, one of the depth
    by_twist: Array  # (m, 3, 6) translation first, camera frame
    by_point: Array  # (m, 3, 3)


def adjust(problem: Problem, poses: Array, positions: Array) -> tuple[Array, Array] | None:
    """Poses (views, 4, 4), world_from_camera, and points (points, 3) that fit better; None where none do."""
    best, damping = (poses, positions), 1e-4
    at = first = linearise(problem, poses, positions)
    for _ in range(STEPS):
        step = gauss_newton(problem, at, damping)
        if not (np.isfinite(step.twists).all() and np.isfinite(step.shifts).all()):
            break
        moved, shifted = moved_by(step, *best)
        tried = linearise(problem, moved, shifted)
        gained = at.cost - tried.cost
        if gained <= 0.0:
            damping *= 100.0
            continue
        best, at, damping = (moved, shifted), tried, 0.1 * damping
        if gained < SETTLED * at.cost:
            break
    return best if at.cost < first.cost else None


def moved_by(step: Step, poses: Array, positions: Array) -> tuple[Array, Array]:
    """Poses and points after a step; those that can't move stay."""
    moved, shifted = poses.copy(), positions.copy()
    for i, twist in enumerate(step.twists):
        moved[i] = moved[i] @ se3_exp(twist)
    shifted[: len(step.shifts)] += step.shifts
    return moved, shifted


def linearise(problem: Problem, poses: Array, positions: Array) -> Linear:
    """The problem at poses (views, 4, 4), world_from_camera, and points (points, 3)."""
    turned, centre = poses[problem.view, :3, :3], poses[problem.view, :3, 3]
    local = np.einsum("nji,nj->ni", turned, positions[problem.point] - centre)
    visible = local[:, 2] > LEAST_DEPTH
    z = np.where(visible, local[:, 2], 1.0)
    xy = np.where(visible[:, None], local[:, :2], 0.0) / z[:, None]
    scale = np.where(visible[:, None], problem.inverse_sigma, 0.0)
    pixel = (xy - problem.rays) * scale
    by_local = np.zeros((len(z), 3, 3))
    by_local[:, 0, 0], by_local[:, 1, 1] = scale.T / z
    by_local[:, :2, 2] = -xy * scale / z[:, None]
    # A doubtful depth smears the point: covariance I + s s^T, whose root shrinks what lies along s.
    error = np.einsum("nji,nj->ni", turned, problem.depth_error[problem.point])
    smear = np.einsum("nij,nj->ni", by_local[:, :2], error)
    length2 = np.einsum("ni,ni->n", smear, smear)
    shrink = smear * ((1.0 - 1.0 / np.sqrt(1.0 + length2)) / np.maximum(length2, 1e-12))[:, None]
    pixel -= smear * np.einsum("ni,ni->n", shrink, pixel)[:, None]
    by_local[:, :2] -= smear[:, :, None] * np.einsum("ni,nij->nj", shrink, by_local[:, :2])[:, None]
    chi = np.where(visible, np.sqrt(np.maximum(np.einsum("ni,ni->n", pixel, pixel), 1e-12)), BEHIND)
    clipped = np.minimum(chi, HUBER)
    cost = float(problem.weight @ (clipped * (2.0 * chi - clipped)))
    root = np.sqrt(problem.weight * clipped / chi)[:, None]
    by_local[:, :2] *= root[:, :, None]
    heard = np.where(visible, problem.depth_weight, 0.0)
    depth = heard * (np.log(z) - problem.log_depth)
    by_local[:, 2, 2] = heard / z
    by_twist = np.concatenate([-by_local, np.cross(by_local, local[:, None, :])], axis=2)
    return Linear(
        cost + float(depth @ depth),
        np.concatenate([pixel * root, depth[:, None]], axis=1),
        by_twist,
        np.einsum("nij,nkj->nik", by_local, turned),
    )


@dataclass(frozen=True)
class Step:
    """Where one step of Gauss-Newton goes."""

    twists: Array  # (free views, 6)
    shifts: Array  # (free points, 3)
    shared: Array  # (k,) of what all observations have in common
    covariance: Array  # (k, k) of that, as sure as the damping has it


def gauss_newton(problem: Problem, at: Linear, damping: float, by_shared: Array | None = None) -> Step:
    """One damped step; ``by_shared`` (m, 3, k) are Jacobians by variables that observations share, if any.

    Raises LinAlgError where nothing tells one of them.
    """
    views, points = problem.free_views, problem.free_points
    shared = np.zeros((*at.residual.shape, 0)) if by_shared is None else by_shared
    known = shared.shape[2]
    rest = slice(6 * views, 6 * views + known)
    camera, camera_pull = np.zeros((rest.stop, rest.stop)), np.zeros(rest.stop)
    for i in range(views):
        mine, block = problem.view == i, slice(6 * i, 6 * i + 6)
        by_twist = at.by_twist[mine].reshape(-1, 6)
        camera[block, block] = by_twist.T @ by_twist
        camera[block, rest] = by_twist.T @ shared[mine].reshape(len(by_twist), known)
        camera[rest, block] = camera[block, rest].T
        camera_pull[block] = by_twist.T @ at.residual[mine].ravel()
    in_rows = shared.reshape(at.residual.size, known)
    camera[rest, rest], camera_pull[rest] = in_rows.T @ in_rows, in_rows.T @ at.residual.ravel()
    own = problem.point < points
    view, point, by_point = problem.view[own], problem.point[own], at.by_point[own]
    hessian = _summed(point, np.einsum("nki,nkj->nij", by_point, by_point).reshape(-1, 9), points)
    hessian = hessian.reshape(-1, 3, 3)
    gradient = _summed(point, np.einsum("nki,nk->ni", by_point, at.residual[own]), points)
    for matrix in (hessian, camera[None]):
        diagonal = np.arange(matrix.shape[-1])
        matrix[:, diagonal, diagonal] = (1.0 + damping) * matrix[:, diagonal, diagonal] + FLOOR
    joint = view < views
    cross = np.zeros((points, 3, views, 6))
    blocks = np.einsum("nki,nkj->nij", by_point[joint], at.by_twist[own][joint])
    cross[point[joint], :, view[joint], :] = blocks
    flat = cross.reshape(3 * points, 6 * views)
    if known:
        by_both = np.einsum("nki,nkj->nij", by_point, shared[own]).reshape(-1, 3 * known)
        flat = np.hstack([flat, _summed(point, by_both, points).reshape(3 * points, known)])
    inverted = np.linalg.inv(hessian)
    solved = (inverted @ flat.reshape(points, 3, rest.stop)).reshape(3 * points, rest.stop)
    reduced = camera - flat.T @ solved
    step = -np.linalg.solve(reduced, camera_pull - solved.T @ gradient.ravel())
    shifts = -np.einsum("nij,nj->ni", inverted, gradient) - (solved @ step).reshape(points, 3)
    twists = np.asarray(step[: rest.start], np.float64).reshape(views, 6)
    covariance = np.linalg.solve(reduced, np.eye(rest.stop)[:, rest])[rest] if known else np.zeros((0, 0))
    return Step(twists, shifts, np.asarray(step[rest], np.float64), np.asarray(covariance, np.float64))


def _summed(groups: Index, rows: Array, count: int) -> Array:
    """Rows (n, k) added up by group: (count, k)."""
    return np.stack([np.bincount(groups, column, count) for column in rows.T], axis=1)
