"""The relative pose of two views from their matches alone, by least squares on epipolar distances."""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, normalised, se3_exp, skew
from prism_edge.tracking.triangulation import rays

HUBER_PX = 1.0
ITERATIONS, STEP, DAMPING = 15, 1e-6, 1e-3
UNDETERMINED, NO_STEP = 1e-10, 1e-10


def sampson_distances(camera: Camera, first: Array, second: Array, first_from_second: Array) -> Array:
    """First-order geometric distances (n,) in pixels of matches (n, 2) from epipolar geometry.

    Hartley and Zisserman, equation 11.9, in normalised coordinates; the focal length (its geometric mean)
    makes pixels of them.
    """
    ray_a, ray_b = rays(camera, first), rays(camera, second)
    essential = skew(first_from_second[:3, 3]) @ first_from_second[:3, :3]
    line_a, line_b = ray_b @ essential.T, ray_a @ essential
    error = np.einsum("ij,ij->i", ray_a, line_a)
    slope = (line_a[:, :2] ** 2).sum(axis=1) + (line_b[:, :2] ** 2).sum(axis=1)
    distances: Array = error / np.sqrt(np.maximum(slope, 1e-18)) * np.sqrt(camera.fx * camera.fy)
    return distances


def refine_two_view_pose(
    camera: Camera, first: Array, second: Array, first_from_second: Array
) -> tuple[Array, float]:
    """Refine a relative pose (4, 4); also the cost, the mean of Huber's function of the distances (px^2).

    Infinite cost, and the pose as given, where the matches don't determine one (all on a spot, say).
    The translation keeps its length, of which matches say nothing. Levenberg-Marquardt with numerical
    derivatives: six evaluations over some hundred matches cost less than the bookkeeping of analytic ones.
    """
    length = float(np.linalg.norm(first_from_second[:3, 3]))
    if length < 1e-12:
        return first_from_second, np.inf
    pose = _with_length(first_from_second, 1.0)
    distances = sampson_distances(camera, first, second, pose)
    cost, damping = robust_cost(distances), DAMPING
    for _ in range(ITERATIONS):
        jacobian = np.empty((len(first), 6))
        for i, direction in enumerate(np.eye(6)):
            moved = pose @ se3_exp(STEP * direction)
            jacobian[:, i] = (sampson_distances(camera, first, second, moved) - distances) / STEP
        weights = np.minimum(1.0, HUBER_PX / np.maximum(np.abs(distances), 1e-12))
        hessian = jacobian.T @ (weights[:, None] * jacobian)
        # The length of the translation has no curvature: a step along it would be arbitrarily long.
        lengthwise = np.concatenate([pose[:3, :3].T @ pose[:3, 3], np.zeros(3)])
        held = hessian + np.trace(hessian) * np.outer(lengthwise, lengthwise)
        if np.linalg.eigvalsh(held)[0] <= UNDETERMINED * np.trace(hessian):
            return first_from_second, np.inf
        step = np.linalg.solve(held + damping * np.diag(np.diag(hessian)), jacobian.T @ (weights * distances))
        if np.linalg.norm(step) < NO_STEP:
            break
        tried = _with_length(pose @ se3_exp(-step), 1.0)
        tried_distances = sampson_distances(camera, first, second, tried)
        tried_cost = robust_cost(tried_distances)
        if not tried_cost < cost:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        done = cost - tried_cost < 1e-6 * cost
        pose, distances, cost, damping = tried, tried_distances, tried_cost, 0.1 * damping
        if done:
            break
    return _with_length(pose, length), cost


def lead_apart(one: Array, other: Array, angle: float) -> bool:
    """Whether two relative poses (4, 4) go in directions that are more than ``angle`` (rad) apart."""
    way, way_of_other = one[:3, 3], other[:3, 3]
    lengths = float(np.linalg.norm(way) * np.linalg.norm(way_of_other))
    return bool(way @ way_of_other < np.cos(angle) * lengths)


def robust_cost(distances: Array) -> float:
    """Mean of Huber's function of distances in pixels (px^2)."""
    size = np.abs(distances)
    return float(np.mean(np.where(size < HUBER_PX, 0.5 * size**2, HUBER_PX * (size - 0.5 * HUBER_PX))))


def _with_length(pose: Array, length: float) -> Array:
    pose = normalised(pose)
    pose[:3, 3] *= length / max(float(np.linalg.norm(pose[:3, 3])), 1e-12)
    return pose
