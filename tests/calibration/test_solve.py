"""Intrinsics from pictures and from corners, against the camera that made them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.calibration import verdict
from prism_edge.calibration.board import Board, View
from prism_edge.calibration.refine import Fit, project, refine
from prism_edge.calibration.solve import _pose, calibrate
from prism_edge.errors import CalibrationError
from prism_edge.geometry.cameras import PINHOLE, Camera
from tests.calibration.board_scene import FISHEYE_CAMERA, PINHOLE_CAMERA, gallery, poses, seen

CHESSBOARD = Board.parse("chessboard:9x6")


def largest_difference(one: Camera, other: Camera) -> float:
    """How far apart (pixels) two cameras see the same rays, over the whole image but its outermost."""
    v, u = np.mgrid[0.04 : 0.97 : 20j, 0.04 : 0.97 : 20j]
    rays = one.normalise(np.stack([u.ravel() * one.width, v.ravel() * one.height], axis=1))
    points = np.column_stack([rays, np.ones(len(rays))])
    return float(np.linalg.norm(one.project(points) - other.project(points), axis=1).max())


@pytest.mark.parametrize("camera", [PINHOLE_CAMERA, FISHEYE_CAMERA], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("spec", ["chessboard:9x6", "charuco:9x7"])
def test_pictures_of_a_board_give_the_camera_back(spec: str, camera: Camera) -> None:
    board = Board.parse(spec)
    views = [view for view in map(board.find, gallery(spec, camera)[1]) if view is not None]
    result = calibrate(board, views, camera.width, camera.height, camera.model)
    found = result.camera
    assert found.model == camera.model
    assert found.fx == pytest.approx(camera.fx, rel=0.003)
    assert found.fy == pytest.approx(camera.fy, rel=0.003)
    assert (found.cx, found.cy) == pytest.approx((camera.cx, camera.cy), abs=1.5)
    assert result.rms < 0.3
    assert largest_difference(camera, found) < 2.0
    off = [getattr(found, name) - getattr(camera, name) for name in ("fx", "fy", "cx", "cy")]
    assert np.abs(np.array(off) / result.sigmas).max() < 3.5


@pytest.mark.parametrize("camera", [PINHOLE_CAMERA, FISHEYE_CAMERA], ids=["pinhole", "fisheye"])
def test_the_uncertainty_told_is_the_one_there_is(camera: Camera) -> None:
    deviations = []
    for seed in range(6):
        views = seen(CHESSBOARD, camera, poses(14, CHESSBOARD, camera, seed), 0.2, seed)
        result = calibrate(CHESSBOARD, views, camera.width, camera.height, camera.model)
        assert result.rms == pytest.approx(0.2 * np.sqrt(2), rel=0.12)
        errors = [getattr(result.camera, name) - getattr(camera, name) for name in ("fx", "fy", "cx", "cy")]
        deviations += list(np.array(errors) / result.sigmas)
    # In standard deviations: one, on average over 24 (which themselves scatter by a seventh or more).
    assert 0.6 < np.sqrt(np.mean(np.square(deviations))) < 1.6
    assert np.abs(deviations).max() < 4.5


def test_tilts_are_those_of_the_board() -> None:
    def pose(about_x: float, about_y: float) -> np.ndarray:
        import cv2

        camera_from_board = np.eye(4)
        camera_from_board[:3, :3] = cv2.Rodrigues(np.radians([about_x, about_y, 0.0]))[0]
        middle = np.append(CHESSBOARD.outline.mean(axis=0), 0.0)
        camera_from_board[:3, 3] = np.array([0.0, 0.0, 12.0]) - camera_from_board[:3, :3] @ middle
        return camera_from_board

    tilts = [(0, 0), (25, 0), (-30, 0), (0, 20), (0, -35), (15, 15), (-20, 10), (40, 0), (0, 40), (10, -25)]
    views = seen(CHESSBOARD, PINHOLE_CAMERA, [pose(*tilt) for tilt in tilts], 0.05)
    result = calibrate(CHESSBOARD, views, 640, 480, PINHOLE)
    straight = [k for k, (x, y) in enumerate(tilts) if x == 0 or y == 0]
    assert len(result.used) == len(tilts)
    for k in straight:
        about_x, about_y = tilts[k]
        np.testing.assert_allclose(np.abs(result.tilts[k]), np.abs([about_y, about_x]), atol=1.5)


def test_views_that_moved_during_exposure_are_left_out() -> None:
    views = seen(CHESSBOARD, PINHOLE_CAMERA, poses(16, CHESSBOARD, PINHOLE_CAMERA), 0.1)
    rng = np.random.default_rng(1)
    for k in (3, 11):
        views[k] = View(views[k].corners, views[k].pixels + rng.normal(0, 3.0, views[k].pixels.shape))
    result = calibrate(CHESSBOARD, views, 640, 480, PINHOLE)
    assert set(range(16)) - set(result.used) == {3, 11}
    assert result.camera.fx == pytest.approx(PINHOLE_CAMERA.fx, rel=0.002)
    assert len(result.residuals) == len(result.tilts) == 14


def test_a_coefficient_that_nothing_speaks_for_is_left_out() -> None:
    # Made with k1 and k2 alone: no fifth number to fit noise with.
    views = seen(CHESSBOARD, PINHOLE_CAMERA, poses(14, CHESSBOARD, PINHOLE_CAMERA), 0.2)
    assert len(calibrate(CHESSBOARD, views, 640, 480, PINHOLE).camera.distortion) == 4
    strong = Camera(640, 480, 400.0, 400.0, 320.0, 240.0, distortion=(-0.35, 0.2, 0.0, 0.0, -0.08))
    views = seen(CHESSBOARD, strong, poses(20, CHESSBOARD, strong), 0.05)
    found = calibrate(CHESSBOARD, views, 640, 480, PINHOLE).camera.distortion
    assert found[4] == pytest.approx(-0.08, abs=0.02)


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_views_that_mean_nothing_are_refused(model: str) -> None:
    rng = np.random.default_rng(0)
    straight = [np.tile(np.linspace(0, 1, 54)[:, None], (1, 2)) * 100 + 50 * k for k in range(12)]
    scattered = [rng.uniform(0, 480, (54, 2)) for _ in range(12)]
    point = [np.full((54, 2), 30.0 * k) for k in range(12)]
    for pixels in (straight, scattered, point):
        views = [View(np.arange(54), at) for at in pixels]
        try:
            problems = verdict.of_result(calibrate(CHESSBOARD, views, 640, 480, model))
        except CalibrationError as error:
            problems = [str(error)]
        assert problems
        assert "\n" not in problems[0]


@pytest.mark.parametrize("camera", [PINHOLE_CAMERA, FISHEYE_CAMERA], ids=["pinhole", "fisheye"])
def test_derivatives(camera: Camera) -> None:
    rotation, translation = np.array([0.3, -0.2, 0.1]), np.array([-2.0, 1.0, 9.0])
    _, slopes = project(CHESSBOARD.points, rotation, translation, camera)
    step = 1e-6

    def moved(k: int, by: float) -> np.ndarray:
        pose = np.concatenate([rotation, translation])
        inner = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])
        (pose if k < 6 else inner)[k if k < 6 else k - 6] += by
        other = Camera(640, 480, *inner[:4], camera.model, tuple(inner[4:]))
        return project(CHESSBOARD.points, pose[:3], pose[3:], other)[0].ravel()

    for k in range(slopes.shape[1]):
        numerical = (moved(k, step) - moved(k, -step)) / (2 * step)
        np.testing.assert_allclose(slopes[:, k], numerical, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("factor", [1.5, 2.0])
def test_a_step_that_leads_nowhere_is_not_the_end_of_the_search(factor: float) -> None:
    """From a focal length that is wrong by far, Newton's first steps go too far: shorter ones do not."""
    camera = FISHEYE_CAMERA
    views = seen(CHESSBOARD, camera, poses(12, CHESSBOARD, camera), 0.0)
    distorted = (0.3, 0.0, 0.0, 0.0)
    start = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy, distortion=distorted)
    placed = [_pose(CHESSBOARD, view, start) for view in views]
    begun = Fit(start, [turn for turn, _ in placed], [place for _, place in placed])
    assert largest_difference(camera, refine(CHESSBOARD, views, begun).camera) < 0.01


BOARD = Board.parse("chessboard:9x6")


def test_views_are_left_out_only_where_most_of_them_agree() -> None:
    rng = np.random.default_rng(0)
    views = seen(BOARD, PINHOLE_CAMERA, poses(20, BOARD, PINHOLE_CAMERA), 0.1)
    for blurred, kept in ((4, 16), (9, 20)):
        off = [
            View(v.corners, v.pixels + (rng.normal(0, 2.0, v.pixels.shape) if k < blurred else 0.0))
            for k, v in enumerate(views)
        ]
        assert len(calibrate(BOARD, off, 640, 480, "pinhole").used) == kept
