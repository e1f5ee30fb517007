"""Robust pose of one camera from points at known places: Gauss-Newton on reprojection errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, se3_exp
from prism_edge.tracking.motion import Prediction

CHI2_2D_95 = 5.991
HUBER = np.sqrt(CHI2_2D_95)
BEHIND = 1e3
Linearised: TypeAlias = tuple[Array, Array, Array]  # residuals, Jacobian, chi2
WIDEST = 10.0  # tangent of the widest angle off the axis that counts as seen


@dataclass(frozen=True)
class PoseEstimate:
    """Pose of the camera, which measurements agree with it, and how certain it is."""

    world_from_camera: Array  # (4, 4)
    inliers: NDArray[np.bool_]  # (n,)
    information: Array  # (6, 6): translation first, camera frame; the measurements' alone

    @property
    def covariance(self) -> Array:
        """The inverse of ``information``, worked out when asked for: most estimates are only a start."""
        return _inverse_information(self.information)


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
    prediction: Prediction | None = None,
) -> PoseEstimate:
    """Minimise the Huber reprojection error over the camera pose.

    points (n, 3) in the world; pixels (n, 2), ideal; sigmas (n,) in pixels. ``depth_error`` (n, 3) is
    the one-sigma error vector of a point along the ray it was first seen by (zero where it is well
    triangulated): its projection inflates the noise in that one direction, so that a point of doubtful
    depth still fixes rotation. ``weights`` (n,) scale the information; ``prediction`` is one measurement
    more. Each round ends with a fresh choice of inliers at the 95 % bound.
    """
    pose = world_from_camera.copy()
    n = len(points)
    inliers = np.ones(n, bool)
    problem = _Problem(camera, points, pixels, 1.0 / sigmas, depth_error)
    share = np.ones(n) if weights is None else weights
    information, at = np.eye(6) * 1e-9, problem.linearise(pose)
    for _ in range(rounds):
        weighed = np.where(inliers, share, 0.0)
        pose, information, at = _descend(problem, pose, at, weighed, iterations, prediction)
        chosen = at[2] < CHI2_2D_95
        settled = bool((chosen == inliers).all())
        inliers = chosen
        if settled or np.count_nonzero(inliers) < 6:
            break
    return PoseEstimate(pose, inliers, information)


def _inverse_information(information: Array) -> Array:
    """Covariance (6, 6); a direction that nothing measures gets a huge variance (a pseudo-inverse: none)."""
    inverted, inverse = cv2.invert(information, flags=cv2.DECOMP_CHOLESKY)
    if inverted and np.trace(inverse) < 1e6:  # far from where eigenvalues would have to be bounded
        return np.asarray(0.5 * (inverse + inverse.T), np.float64)
    values, vectors = np.linalg.eigh(information)
    covariance: Array = np.asarray((vectors / np.maximum(values, 1e-9)) @ vectors.T, np.float64)
    return covariance


def _descend(
    problem: _Problem,
    pose: Array,
    at: Linearised,
    share: Array,
    iterations: int,
    prediction: Prediction | None,
) -> tuple[Array, Array, Linearised]:
    """Levenberg-Marquardt on the Huber cost from a pose with the problem linearised ``at`` it.

    Returns the best pose, the measurements' information (6, 6) on it and the problem there.
    """
    best, best_cost, best_at, damping = pose, np.inf, at, 1e-6
    kept_information = normal = np.eye(6)
    kept_gradient, pull = np.zeros(6), None
    for step in range(iterations + 1):
        if step:
            at = problem.linearise(pose)
        residual, jacobian, chi2 = at
        root = np.sqrt(np.maximum(chi2, 1e-12))
        clipped = np.minimum(root, HUBER)
        # A point behind the camera (chi2 of inf) costs like a gross outlier: hiding one must not look good.
        cost = float(share @ np.minimum(clipped * (2.0 * root - clipped), BEHIND))
        if prediction is not None:
            pull = prediction.pull(pose)
            cost += pull[0]
        if cost < best_cost:
            settled = best_cost - cost < 1e-3 * cost
            weighted = (jacobian * (share * (clipped / root))).reshape(6, -1)
            kept_information = weighted @ jacobian.reshape(6, -1).T
            kept_gradient = weighted @ residual.ravel()
            normal = kept_information
            if pull is not None:
                normal, kept_gradient = normal + pull[1], kept_gradient + pull[2]
            best, best_cost, best_at, damping = pose, cost, at, damping * 0.1
            if settled or step == iterations:
                break
        else:
            damping = max(damping, 1e-6) * 100.0
        damped = normal.copy()
        damped.flat[::7] += damping * damped.flat[::7] + 1e-9
        # OpenCV's takes a third of the time of numpy's for so few unknowns.
        _, twist = cv2.solve(damped, -kept_gradient[:, None])
        pose = best @ se3_exp(twist[:, 0])
    return best, kept_information, best_at


class _Problem:
    """What stays the same while the pose moves."""

    def __init__(
        self, camera: Camera, points: Array, pixels: Array, inverse_sigma: Array, depth_error: Array | None
    ) -> None:
        # Columns of points side by side, so that each step below is one call for both of a pixel's axes.
        self._points = np.ascontiguousarray(points.T)
        self._depth_error = None if depth_error is None else np.ascontiguousarray(depth_error.T)
        self._focal = np.array([[camera.fx], [camera.fy]]) * inverse_sigma
        self._offset = (np.array([[camera.cx], [camera.cy]]) - pixels.T) * inverse_sigma

    def linearise(self, pose: Array) -> Linearised:
        """Whitened residuals (2, n), their Jacobian (6, 2, n) by the right-hand twist of the pose, chi2 (n,).

        What is behind the camera or far beyond its field of view has zero residual and Jacobian, chi2 inf.
        """
        to_camera = pose[:3, :3].T
        local = to_camera @ (self._points - pose[:3, 3:])
        z, focal, offset = local[2], self._focal, self._offset
        # Also a bound on every number below: what is seen nearly edge-on says nothing but can overflow.
        aside = np.abs(local[:2])
        visible = (z > 1e-3) & (np.maximum(aside[0], aside[1]) < WIDEST * z)
        all_visible = bool(visible.all())
        if not all_visible:
            z = np.where(visible, z, np.inf)
            focal, offset = np.where(visible, focal, 0.0), np.where(visible, offset, 0.0)
        inverse_z = 1.0 / z
        xy = local[:2] * inverse_z
        x, y = xy
        seen, by_z = focal * xy, focal * inverse_z
        residual = seen + offset
        # d(pixel)/d(point) times d(point)/d(twist), with point' = point - rho - phi x point.
        jacobian = np.zeros((6, 2, len(x)))
        np.negative(by_z[0], out=jacobian[0, 0])
        np.negative(by_z[1], out=jacobian[1, 1])
        np.multiply(seen, inverse_z, out=jacobian[2])
        np.multiply(seen, y, out=jacobian[3])
        jacobian[3, 1] += focal[1]
        np.multiply(seen, -x, out=jacobian[4])
        jacobian[4, 0] -= focal[0]
        np.multiply(focal[0], y, out=jacobian[5, 0])
        np.multiply(focal[1], -x, out=jacobian[5, 1])
        if self._depth_error is not None:
            error = to_camera @ self._depth_error
            smear = by_z * (error[:2] - xy * error[2])
            # Covariance I + s s^T; its inverse square root shrinks what lies along s and leaves the rest.
            length2 = smear[0] * smear[0] + smear[1] * smear[1]
            scaled = smear * ((1.0 - 1.0 / np.sqrt(1.0 + length2)) / np.maximum(length2, 1e-12))
            residual -= smear * (scaled[0] * residual[0] + scaled[1] * residual[1])
            along = jacobian[:, 0] * scaled[0] + jacobian[:, 1] * scaled[1]
            jacobian -= along[:, None] * smear
        chi2 = residual[0] * residual[0] + residual[1] * residual[1]
        return residual, jacobian, chi2 if all_visible else np.where(visible, chi2, np.inf)
