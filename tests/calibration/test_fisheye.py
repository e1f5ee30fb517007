"""A fisheye's projection against its formula, OpenCV and differences; calibrations with corners behind."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from prism_edge.calibration import fisheye
from prism_edge.calibration.board import Board, View
from prism_edge.calibration.solve import calibrate
from prism_edge.geometry.cameras import FISHEYE, Camera

WIDE = Camera(1280, 960, 410.0, 411.0, 642.0, 470.0, FISHEYE, (-0.03, 0.005, -0.002, 0.0003))
BOARD = Board.parse("chessboard:9x6")


def by_formula(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Pixels of points (n, 3) in the camera's frame."""
    angle = np.arccos(points[:, 2] / np.linalg.norm(points, axis=1))
    k1, k2, k3, k4 = camera.distortion
    reach = angle + k1 * angle**3 + k2 * angle**5 + k3 * angle**7 + k4 * angle**9
    towards = np.arctan2(points[:, 1], points[:, 0])
    at = np.column_stack([np.cos(towards), np.sin(towards)]) * reach[:, None]
    return at * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def facing(off_axis: float, towards: float, distance: float, tilt: tuple[float, float, float]) -> np.ndarray:
    """camera_from_board of a board in a direction (rad), turned to the camera but for a tilt (rad)."""
    ray = np.array([np.sin(off_axis) * np.cos(towards), np.sin(off_axis) * np.sin(towards), np.cos(off_axis)])
    axis = np.cross([0.0, 0.0, 1.0], ray)
    axis *= off_axis / max(np.linalg.norm(axis), 1e-12)
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(axis)[0] @ cv2.Rodrigues(np.array(tilt))[0]
    pose[:3, 3] = ray * distance - pose[:3, :3] @ np.append(BOARD.outline.mean(axis=0), 0.0)
    return pose


def boards(reach_deg: float, count: int, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [
        facing(
            np.radians(rng.uniform(0, reach_deg)),
            rng.uniform(-np.pi, np.pi),
            rng.uniform(6.0, 12.0),
            tuple(rng.uniform(-0.6, 0.6, 3)),
        )
        for _ in range(count)
    ]


@pytest.mark.parametrize("off_axis", [0.0, 0.7, 1.5, 1.62, 2.0])
def test_pixels_and_derivatives_before_and_behind_the_plane_of_the_lens(off_axis: float) -> None:
    pose = facing(off_axis, 2.1, 9.0, (0.3, -0.2, 0.4))
    vector, translation = cv2.Rodrigues(pose[:3, :3])[0].ravel(), pose[:3, 3]
    pixels, slopes = fisheye.project(BOARD.points, vector, translation, WIDE)
    seen = BOARD.points @ pose[:3, :3].T + translation
    np.testing.assert_allclose(pixels, by_formula(seen, WIDE), atol=1e-8)
    inner = np.array([WIDE.fx, WIDE.fy, WIDE.cx, WIDE.cy, *WIDE.distortion])
    whole = np.concatenate([vector, translation, inner])

    def at(values: np.ndarray) -> np.ndarray:
        camera = Camera(1280, 960, *values[6:10], FISHEYE, tuple(values[10:]))
        return fisheye.project(BOARD.points, values[:3], values[3:6], camera)[0]

    for k in range(14):
        step = np.zeros(14)
        step[k] = 1e-6
        numerical = (at(whole + step) - at(whole - step)) / 2e-6
        np.testing.assert_allclose(slopes[:, :, k], numerical, rtol=1e-5, atol=2e-3)


def test_before_the_lens_it_is_opencv_s() -> None:
    pose = facing(0.9, -0.4, 8.0, (0.1, 0.3, -0.2))
    vector, translation = cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3]
    distortion = np.array(WIDE.distortion)
    given = BOARD.points.reshape(-1, 1, 3), vector, translation, WIDE.matrix, distortion
    pixels, slopes = cv2.fisheye.projectPoints(*given)
    mine, derivative = fisheye.project(BOARD.points, vector, translation, WIDE)
    np.testing.assert_allclose(mine, pixels.reshape(-1, 2), atol=1e-9)
    order = [8, 9, 10, 11, 12, 13, 0, 1, 2, 3, 4, 5, 6, 7]
    np.testing.assert_allclose(derivative.reshape(-1, 14), slopes[:, order], rtol=1e-6, atol=1e-6)


def test_a_point_on_the_axis_is_at_the_centre() -> None:
    pixels, slopes = fisheye.project(np.zeros((1, 3)), np.zeros(3), np.array([0.0, 0.0, 2.0]), WIDE)
    np.testing.assert_allclose(pixels[0], (WIDE.cx, WIDE.cy), atol=1e-6)
    assert np.isfinite(slopes).all()
    np.testing.assert_allclose(slopes[0, 0, 3], WIDE.fx / 2.0, rtol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_boards_with_corners_beyond_90_degrees_give_the_camera_back(seed: int) -> None:
    rng, views, beyond = np.random.default_rng(seed), [], 0
    for pose in boards(80.0, 20, seed):
        points = BOARD.points @ pose[:3, :3].T + pose[:3, 3]
        beyond += int((points[:, 2] < 0).sum())
        views.append(View(np.arange(len(points)), by_formula(points, WIDE) + rng.normal(0, 0.1, (54, 2))))
    assert beyond >= 10
    result = calibrate(BOARD, views, WIDE.width, WIDE.height, FISHEYE)
    assert len(result.used) == len(views)
    assert result.rms == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
    off = [getattr(result.camera, name) - getattr(WIDE, name) for name in ("fx", "fy", "cx", "cy")]
    assert np.abs(np.array(off) / result.sigmas).max() < 4.0
    assert result.camera.fx == pytest.approx(WIDE.fx, rel=0.002)
