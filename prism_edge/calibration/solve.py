"""From views of a board to intrinsics, and how well these are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from prism_edge.calibration.board import Board, View
from prism_edge.calibration.refine import Fit, refine, residuals, sigmas
from prism_edge.errors import CalibrationError, ConfigError
from prism_edge.geometry.cameras import FISHEYE, PINHOLE, Camera
from prism_edge.geometry.poses import Array

_BLURRED = 2.5  # times the median error of a view: moved during exposure, or a corner mistaken
_LEAST_LEFT = 0.6  # of the views
_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-10)
_SIGMAS = 3.0  # k3 has to be known this well to be worth having
# Views over the image's width that a fisheye's fit is begun from (degrees).
_FISHEYE_FIELDS = (180.0, 140.0, 220.0)


@dataclass(frozen=True)
class Calibration:
    """The camera, and what was left over."""

    camera: Camera
    sigmas: Array  # (4,) standard deviations of fx fy cx cy (pixels)
    used: tuple[int, ...]  # indices of the views that were kept
    residuals: tuple[Array, ...]  # (n, 2) of each view kept: seen less projected (pixels)
    tilts: Array  # (views kept, 2) of the board against the image plane: sideways, up and down (degrees)

    @property
    def rms(self) -> float:
        """Reprojection error: root mean square distance (pixels)."""
        return _rms(np.concatenate(self.residuals))


def calibrate(board: Board, views: Sequence[View], width: int, height: int, model: str) -> Calibration:
    """Intrinsics that minimise the reprojection error; views that stay far off are left out, once.

    ``model`` is pinhole (k1 k2 p1 p2, and k3 where it is known to 3 sigma) or fisheye (k1 to k4). Raises
    CalibrationError where the views give no solution.
    """
    used = list(range(len(views)))
    fit = _fit(board, views, width, height, model)
    errors = np.array([_rms(r) for r in residuals(board, views, fit)])
    good = [i for i in used if errors[i] <= _BLURRED * np.median(errors)]
    if _LEAST_LEFT * len(used) <= len(good) < len(used):
        used = good
        fit = _fit(board, [views[i] for i in used], width, height, model)
    kept = [views[i] for i in used]
    spread = sigmas(board, kept, fit)
    if model == PINHOLE and abs(fit.camera.distortion[4]) < _SIGMAS * spread[8]:
        fit = _fit(board, kept, width, height, model, with_k3=False)
        spread = sigmas(board, kept, fit)
    tilts = np.array([_tilt(rotation) for rotation in fit.rotations])
    return Calibration(fit.camera, spread[:4], tuple(used), tuple(residuals(board, kept, fit)), tilts)


def _rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def _tilt(rotation: Array) -> Array:
    """Slope of a board (2,) against the image plane; without any, nothing tells length from distance."""
    normal = cv2.Rodrigues(rotation)[0][:, 2]
    normal = normal * np.where(normal[2] < 0, -1.0, 1.0)
    return np.degrees(np.arctan2(normal[:2], normal[2]))


def _facing(ray: Array) -> Array:
    """Rotation (3, 3) of the shortest way that turns a ray (3,) to the optical axis."""
    unit = ray / np.linalg.norm(ray)
    axis = np.cross(unit, (0.0, 0.0, 1.0))
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, unit[2])
    return cv2.Rodrigues(axis / max(sine, 1e-12) * angle)[0]


def _fit(
    board: Board, views: Sequence[View], width: int, height: int, model: str, with_k3: bool = True
) -> Fit:
    try:
        if model == FISHEYE:
            return _fit_fisheye(board, views, width, height)
        return _fit_pinhole(board, views, width, height, with_k3)
    except (cv2.error, np.linalg.LinAlgError, ConfigError):  # the last: of a camera that can't be
        raise _no_solution() from None


def _fit_pinhole(board: Board, views: Sequence[View], width: int, height: int, with_k3: bool) -> Fit:
    _, k, d, rotations, translations = cv2.calibrateCamera(
        [board.points[view.corners].astype(np.float32) for view in views],
        [view.pixels.astype(np.float32) for view in views],
        (width, height),
        None,
        None,
        flags=0 if with_k3 else cv2.CALIB_FIX_K3,
        criteria=_CRITERIA,
    )
    values = [float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2], *d.ravel()[: 5 if with_k3 else 4])]
    if not np.all(np.isfinite(values)) or min(values[:2]) <= 0:
        raise _no_solution()
    fx, fy, cx, cy, *distortion = values
    camera = Camera(width, height, fx, fy, cx, cy, PINHOLE, tuple(distortion))
    return Fit(camera, [np.ravel(r) for r in rotations], [np.ravel(t) for t in translations])


def _fit_fisheye(board: Board, views: Sequence[View], width: int, height: int) -> Fit:
    """The best from several beginnings; OpenCV's own fails on corners far off the axis."""
    fits = []
    for field in _FISHEYE_FIELDS:
        focal = width / np.radians(field)
        start = Camera(
            width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, FISHEYE, (0.0, 0.0, 0.0, 0.0)
        )
        poses = [_pose(board, view, start) for view in views]
        fit = refine(board, views, Fit(start, [pose[0] for pose in poses], [pose[1] for pose in poses]))
        fits.append((_rms(np.concatenate(residuals(board, views, fit))), fit))
    return min(fits, key=lambda pair: pair[0])[1]


def _pose(board: Board, view: View, camera: Camera) -> tuple[Array, Array]:
    """The board's pose as seen by a camera that is about right: rotation vector and translation (3,).

    The camera is turned to the board first, as off the axis a plane's image coordinates run away.
    """
    rays = np.column_stack([camera.normalise(view.pixels), np.ones(len(view.pixels))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    turn = _facing(rays.mean(axis=0))
    turned = rays @ turn.T
    flat = turned[:, :2] / np.maximum(turned[:, 2:], 0.05)
    points = board.points[view.corners]
    _, rotation, translation = cv2.solvePnP(points, flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    return cv2.Rodrigues(turn.T @ cv2.Rodrigues(rotation)[0])[0].ravel(), turn.T @ translation.ravel()


def _no_solution() -> CalibrationError:
    return CalibrationError(
        "the views give no solution: is the board as named, flat, and seen from different sides?"
    )
