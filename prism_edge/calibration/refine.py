"""Least squares over intrinsics and the board's poses: Levenberg-Marquardt with a Schur complement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from prism_edge.calibration import fisheye
from prism_edge.calibration.board import Board, View
from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import FISHEYE, Camera
from prism_edge.geometry.poses import Array

_STEPS = 100
_DONE = 1e-10  # relative change of the cost


@dataclass(frozen=True)
class Fit:
    """A camera, and camera_from_board of each view as a rotation vector (3,) and a translation (3,)."""

    camera: Camera
    rotations: list[Array]
    translations: list[Array]


@dataclass(frozen=True)
class _Normal:
    """Gauss-Newton's equations, block by block: intrinsics, each pose, and between them."""

    inner: Array  # (m, m)
    inner_right: Array  # (m,)
    poses: list[Array]  # (6, 6) each
    pose_rights: list[Array]  # (6,) each
    crosses: list[Array]  # (6, m) each
    cost: float  # sum of squared residuals (pixels squared)


def project(points: Array, rotation: Array, translation: Array, camera: Camera) -> tuple[Array, Array]:
    """Pixels (n, 2) of board points (n, 3), and their derivative (2 n, 6 + m).

    Its columns: rotation vector, translation, fx fy cx cy, distortion.
    """
    if camera.model == FISHEYE:
        pixels, slopes = fisheye.project(points, rotation, translation, camera)
        return pixels, slopes.reshape(2 * len(points), -1)
    distortion, points = np.array(camera.distortion), points.reshape(-1, 1, 3)
    pixels, slopes = cv2.projectPoints(points, rotation, translation, camera.matrix, distortion)
    return pixels.reshape(-1, 2), slopes[:, : 10 + len(distortion)]


def residuals(board: Board, views: Sequence[View], fit: Fit) -> list[Array]:
    """Seen less projected (n, 2) of each view, in pixels."""
    return [
        view.pixels - project(board.points[view.corners], rotation, translation, fit.camera)[0]
        for view, rotation, translation in zip(views, fit.rotations, fit.translations, strict=True)
    ]


def sigmas(board: Board, views: Sequence[View], fit: Fit) -> Array:
    """Standard deviations of fx fy cx cy and the distortion, whatever the poses are."""
    normal = _normal(board, views, fit)
    information = normal.inner.copy()
    for pose, cross in zip(normal.poses, normal.crosses, strict=True):
        information -= cross.T @ np.linalg.pinv(pose) @ cross
    unknowns = len(information) + 6 * len(views)
    freedom = 2 * sum(len(view.pixels) for view in views) - unknowns
    variance = normal.cost / max(freedom, 1)
    return np.sqrt(np.clip(np.diag(np.linalg.pinv(information)) * variance, 0.0, None))


def refine(board: Board, views: Sequence[View], fit: Fit) -> Fit:
    """The least squares solution near ``fit``; raises LinAlgError where the equations have none."""
    damping, normal = 1e-3, _normal(board, views, fit)
    for _ in range(_STEPS):
        trial = _moved(fit, *_solved(normal, damping))
        after = _normal(board, views, trial) if trial is not None else None
        if trial is None or after is None or not after.cost < normal.cost:
            damping *= 10.0
            if damping > 1e8:
                break
            continue
        change = 1.0 - after.cost / normal.cost
        fit, normal, damping = trial, after, max(damping / 10.0, 1e-12)
        if change < _DONE:
            break
    return fit


def _normal(board: Board, views: Sequence[View], fit: Fit) -> _Normal:
    unknowns = 4 + len(fit.camera.distortion)
    inner, right, cost = np.zeros((unknowns, unknowns)), np.zeros(unknowns), 0.0
    poses, rights, crosses = [], [], []
    for view, rotation, translation in zip(views, fit.rotations, fit.translations, strict=True):
        pixels, slopes = project(board.points[view.corners], rotation, translation, fit.camera)
        error = (view.pixels - pixels).ravel()
        by_pose, by_inner = slopes[:, :6], slopes[:, 6:]
        inner += by_inner.T @ by_inner
        right += by_inner.T @ error
        poses.append(by_pose.T @ by_pose)
        rights.append(by_pose.T @ error)
        crosses.append(by_pose.T @ by_inner)
        cost += float(error @ error)
    return _Normal(inner, right, poses, rights, crosses, cost if np.isfinite(cost) else np.inf)


def _solved(normal: _Normal, damping: float) -> tuple[Array, list[Array]]:
    """Steps of the intrinsics (m,) and of each pose (6,)."""
    inner = normal.inner + damping * np.diag(np.diag(normal.inner))
    right = normal.inner_right.copy()
    inverses = [np.linalg.inv(pose + damping * np.diag(np.diag(pose))) for pose in normal.poses]
    for inverse, cross, pose_right in zip(inverses, normal.crosses, normal.pose_rights, strict=True):
        inner -= cross.T @ inverse @ cross
        right -= cross.T @ inverse @ pose_right
    step: Array = np.asarray(np.linalg.solve(inner, right), dtype=np.float64)
    poses = [
        inverse @ (pose_right - cross @ step)
        for inverse, cross, pose_right in zip(inverses, normal.crosses, normal.pose_rights, strict=True)
    ]
    return step, poses


def _moved(fit: Fit, step: Array, poses: list[Array]) -> Fit | None:
    """The fit after a step; None where no camera is like that."""
    camera = fit.camera
    values = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]) + step
    if not np.all(np.isfinite(values)) or values[:2].min() <= 0:
        return None
    fx, fy, cx, cy, *distortion = (float(value) for value in values)
    try:
        moved = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion))
    except ConfigError:
        return None
    return Fit(
        moved,
        [r + p[:3] for r, p in zip(fit.rotations, poses, strict=True)],
        [t + p[3:] for t, p in zip(fit.translations, poses, strict=True)],
    )
