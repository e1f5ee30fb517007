"""Robust pose of one camera from points at known places: Gauss-Newton on reprojection errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, se3_exp

CHI2_2D_95 = 5.991
HUBER = np.sqrt(CHI2_2D_95)
BEHIND = 1e3


@dataclass(frozen=True)
class PoseEstimate:
    """Pose of the camera, which measurements agree with it, and how certain it is."""

    world_from_camera: Array  # (4, 4)
    inliers: NDArray[np.bool_]  # (n,)
    covariance: Array  # (6, 6): translation first, camera frame
    residual_px: float  # rms of the inliers, in sigmas of their pyramid level


def refine_pose(
    camera: Camera,
    world_from_camera: Array,
    points: Array,
    pixels: Array,
    sigmas: Array,
    depth_error: Array | None = None,
    weights: Array | None = None,
    rounds: int = 3,
    iterations: int = 3,
) -> PoseEstimate:
    """Minimise the Huber reprojection error over the camera pose.

    points (n, 3) in the world; pixels (n, 2), ideal; sigmas (n,) in pixels. ``depth_error`` (n, 3) is
    the one-sigma error vector of a point along the ray it was first seen by (zero where it is well
    triangulated): its projection inflates the noise in that one direction, so that a point of doubtful
    depth still fixes rotation. ``weights`` (n,) scale the information. Each round ends with a fresh
    choice of inliers at the 95 % bound.
    """
    pose = world_from_camera.copy()
    n = len(points)
    inliers = np.ones(n, bool)
    inverse_sigma = 1.0 / sigmas
    share = np.ones(n) if weights is None else weights
    information = np.eye(6) * 1e-9
    chi2 = np.zeros(n)
    for _ in range(rounds):
        used = np.where(inliers, share, 0.0)
        pose, information = _descend(
            camera, pose, points, pixels, inverse_sigma, depth_error, used, iterations
        )
        _, _, chi2, visible = _linearise(camera, pose, points, pixels, inverse_sigma, depth_error)
        chosen = visible & (chi2 < CHI2_2D_95)
        settled = np.array_equal(chosen, inliers)
        inliers = chosen
        if settled or inliers.sum() < 6:
            break
    kept = max(int(inliers.sum()), 1)
    spread = float(np.sqrt(chi2[inliers].sum() / (2 * kept))) if inliers.any() else np.inf
    return PoseEstimate(pose, inliers, _inverse_information(information), spread)


def _inverse_information(information: Array) -> Array:
    """Covariance (6, 6); a direction that nothing measures gets a huge variance (a pseudo-inverse: none)."""
    values, vectors = np.linalg.eigh(information)
    covariance: Array = np.asarray((vectors / np.maximum(values, 1e-9)) @ vectors.T, np.float64)
    return covariance


def _descend(
    camera: Camera,
    pose: Array,
    points: Array,
    pixels: Array,
    inverse_sigma: Array,
    depth_error: Array | None,
    share: Array,
    iterations: int,
) -> tuple[Array, Array]:
    """Levenberg-Marquardt on the Huber cost; returns the pose and its information matrix (6, 6)."""
    best, best_cost, damping = pose, np.inf, 1e-6
    kept_information, kept_gradient = np.eye(6), np.zeros(6)
    for _ in range(iterations + 1):
        residual, jacobian, chi2, visible = _linearise(
            camera, pose, points, pixels, inverse_sigma, depth_error
        )
        root = np.sqrt(np.maximum(chi2, 1e-12))
        huber = np.minimum(1.0, HUBER / root)
        rho = np.where(root <= HUBER, chi2, 2.0 * HUBER * root - HUBER**2)
        # A point behind the camera costs like a gross outlier, or steps that hide points would look good.
        cost = float((share * np.where(visible, rho, BEHIND)).sum())
        if cost < best_cost:
            settled = best_cost - cost < 1e-3 * cost
            weight = share * huber * visible
            flat = (jacobian * weight[:, None, None]).reshape(-1, 6)
            kept_information, kept_gradient = flat.T @ jacobian.reshape(-1, 6), flat.T @ residual.ravel()
            best, best_cost, damping = pose, cost, damping * 0.1
            if settled:
                break
        else:
            damping = max(damping, 1e-6) * 100.0
        damped = kept_information + damping * np.diag(np.diag(kept_information)) + 1e-9 * np.eye(6)
        step: Array = np.asarray(np.linalg.solve(damped, -kept_gradient), np.float64)
        pose = best @ se3_exp(step)
    return best, kept_information


def _linearise(
    camera: Camera, pose: Array, points: Array, pixels: Array, inverse_sigma: Array, depth_error: Array | None
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Whitened residuals (n, 2), Jacobians (n, 2, 6) by the right-hand twist of the pose, chi2, in front."""
    rotation = pose[:3, :3]
    local = (points - pose[:3, 3]) @ rotation
    z = local[:, 2]
    visible = z > 1e-3
    inverse_z = 1.0 / np.where(visible, z, 1.0)
    x, y = local[:, 0] * inverse_z, local[:, 1] * inverse_z
    fx, fy = camera.fx * inverse_sigma, camera.fy * inverse_sigma
    residual = np.empty((len(points), 2))
    residual[:, 0] = fx * x + (camera.cx - pixels[:, 0]) * inverse_sigma
    residual[:, 1] = fy * y + (camera.cy - pixels[:, 1]) * inverse_sigma
    jacobian = np.empty((len(points), 2, 6))
    u, v = jacobian[:, 0], jacobian[:, 1]
    # d(pixel)/d(point) times d(point)/d(twist), with point' = point - rho - phi x point.
    u[:, 0] = -fx * inverse_z
    u[:, 1] = 0.0
    u[:, 2] = fx * x * inverse_z
    u[:, 3] = fx * x * y
    u[:, 4] = -fx * (1.0 + x * x)
    u[:, 5] = fx * y
    v[:, 0] = 0.0
    v[:, 1] = -fy * inverse_z
    v[:, 2] = fy * y * inverse_z
    v[:, 3] = fy * (1.0 + y * y)
    v[:, 4] = -fy * x * y
    v[:, 5] = -fy * x
    if depth_error is not None:
        error = depth_error @ rotation
        smear = np.empty((len(points), 2))
        smear[:, 0] = fx * inverse_z * (error[:, 0] - x * error[:, 2])
        smear[:, 1] = fy * inverse_z * (error[:, 1] - y * error[:, 2])
        # Covariance I + s s^T; its inverse square root shrinks what lies along s and leaves the rest.
        length2 = np.einsum("ij,ij->i", smear, smear)
        shrink = (1.0 - 1.0 / np.sqrt(1.0 + length2)) / np.maximum(length2, 1e-12)
        residual -= smear * (shrink * np.einsum("ij,ij->i", smear, residual))[:, None]
        along = np.einsum("ij,ijk->ik", smear, jacobian) * shrink[:, None]
        jacobian -= smear[:, :, None] * along[:, None, :]
    chi2 = np.einsum("ij,ij->i", residual, residual)
    return residual, jacobian, chi2, visible
