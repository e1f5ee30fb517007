"""What is refused, and in which words; what differs, what is drawn, what is written."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.calibration import coverage, verdict
from prism_edge.calibration.board import Board, View
from prism_edge.calibration.camera_text import camera_text
from prism_edge.calibration.solve import Calibration, calibrate
from prism_edge.calibration.views import distinct, outline
from prism_edge.sources.camera_file import parse_camera
from tests.calibration.board_scene import FISHEYE_CAMERA, PINHOLE_CAMERA, poses, seen, truth

BOARD = Board.parse("chessboard:9x6")


@pytest.fixture(scope="module")
def views() -> list[View]:
    return seen(BOARD, PINHOLE_CAMERA, poses(20, BOARD, PINHOLE_CAMERA), 0.1)


@pytest.fixture(scope="module")
def result(views: list[View]) -> Calibration:
    return calibrate(BOARD, views, 640, 480, "pinhole")


def test_good_views_and_a_good_result_pass(views: list[View], result: Calibration) -> None:
    assert verdict.of_views(views, len(views), 640, 480) == []
    assert verdict.of_result(result) == []


def test_too_few_and_too_similar_are_different_words(views: list[View]) -> None:
    assert verdict.of_views(views[:4], 4, 640, 480) == [
        "the board was seen in only 4 different ways, and 10 are needed"
    ]
    (line,) = verdict.of_views(views[:4], 200, 640, 480)
    assert "seen in 200 images, but in only 4 different ways" in line
    assert "tilt" in line


def test_views_in_one_part_of_the_image(views: list[View]) -> None:
    left = [View(view.corners, view.pixels * (0.4, 0.9)) for view in views]
    problems = " ".join(verdict.of_views(left, 20, 640, 480))
    assert "no corner comes near the right edge" in problems
    assert "of the image, and 60% are needed" in problems


def test_a_corner_counts_in_its_cell_and_one_past_the_edge_in_the_outermost() -> None:
    x, y = np.meshgrid((np.arange(6) + 0.5) * 640 / 6, (np.arange(4) + 0.5) * 480 / 4)
    middles = np.column_stack([x.ravel(), y.ravel()])
    past = np.array([[-3.0, -2.0], [642.0, 481.0]])
    expected = np.ones((4, 6), int)
    expected[0, 0] = expected[3, 5] = 2
    view = View(np.arange(26), np.concatenate([middles, past]))
    np.testing.assert_array_equal(verdict.covered([view], 640, 480), expected)


def test_views_that_were_left_out_do_not_count(views: list[View], result: Calibration) -> None:
    assert verdict.of_calibration(views, 20, result) == []
    few = replace(result, used=result.used[:9])
    (line,) = verdict.of_calibration(views, 9, few)
    assert line.startswith("the board was seen in only 9 different ways, and 10 are needed (11 that miss")
    # What is left may also lie in one part of the image.
    upper = tuple(k for k in result.used if views[k].pixels[:, 1].max() < 400)
    assert len(upper) >= 10
    assert "lower edge" in verdict.of_calibration(views, 20, replace(result, used=upper))[0]


def test_a_board_that_is_never_tilted(result: Calibration) -> None:
    tilts = np.zeros((20, 2))
    assert "tilt it left and right" in verdict.of_result(replace(result, tilts=tilts))[0]
    tilts[:5, 0] = 30.0
    assert "tilt it up and down" in verdict.of_result(replace(result, tilts=tilts))[0]


def test_squarely_seen_boards_really_are_refused() -> None:
    flat = seen(BOARD, PINHOLE_CAMERA, poses(20, BOARD, PINHOLE_CAMERA, tilt_deg=1.0), 0.3)
    problems = verdict.of_result(calibrate(BOARD, flat, 640, 480, "pinhole"))
    assert any("faces the camera squarely" in problem for problem in problems)


def test_a_fisheye_taken_for_a_pinhole() -> None:
    views = seen(BOARD, FISHEYE_CAMERA, poses(20, BOARD, FISHEYE_CAMERA), 0.1)
    problems = verdict.of_result(calibrate(BOARD, views, 640, 480, "pinhole"))
    assert any("--model fisheye" in problem for problem in problems)


def test_a_wide_lens_whose_pinhole_folds_over_within_the_image() -> None:
    """It fits every corner to a third of a pixel, and says nonsense of the image's corners."""
    wide = replace(FISHEYE_CAMERA, fx=365.0, fy=365.0)  # 101 degrees
    views = seen(BOARD, wide, poses(25, BOARD, wide), 0.15)
    (problem,) = verdict.of_result(calibrate(BOARD, views, 640, 480, "pinhole"))
    assert "folds over in 3." in problem
    assert "--model fisheye" in problem
    assert verdict.of_result(calibrate(BOARD, views, 640, 480, "fisheye")) == []


@pytest.mark.parametrize("stretch", [1.0, 1.03])
def test_a_board_that_the_printer_has_stretched(stretch: float) -> None:
    camera = replace(PINHOLE_CAMERA, fy=PINHOLE_CAMERA.fx)
    places = [pose @ np.diag([1.0, stretch, 1.0, 1.0]) for pose in poses(20, BOARD, camera)]
    views = seen(BOARD, camera, places, 0.1)
    result = calibrate(BOARD, views, 640, 480, "pinhole")
    assert verdict.of_result(result) == []  # nothing else shows it
    assert bool(verdict.doubt(result.camera)) == (stretch > 1)
    assert "squares are square" in verdict.doubt(replace(camera, fx=1.02 * camera.fy))


def test_large_errors_uncertain_lengths_and_odd_centres(result: Calibration) -> None:
    off = replace(result, residuals=tuple(3.0 + r for r in result.residuals))
    assert "the corners miss by 4" in verdict.of_result(off)[0]
    wide = replace(off.camera, width=5120, height=3840, cx=2560.0, cy=1920.0)
    assert "4 are allowed" in " ".join(verdict.of_result(replace(off, camera=wide)))
    unsure = replace(result, sigmas=np.array([12.0, 3.0, 1.0, 1.0]))
    assert "known to 2.0% only" in verdict.of_result(unsure)[0]
    odd = replace(result, camera=replace(result.camera, cx=80.0))
    assert "optical centre" in verdict.of_result(odd)[0]


def test_views_that_differ_most_come_first() -> None:
    square = np.array([[100.0, 100], [200, 100], [200, 180], [100, 180]])
    shifts = ((0, 0), (3, 3), (300, 0), (302, 1), (0, 200))
    outlines = [square + np.array(shift) for shift in shifts]
    assert distinct(outlines, 640, 60) == [0, 3, 4]
    assert distinct(outlines, 640, 2) == [0, 3]
    assert distinct([], 640, 2) == []
    # The same chessboard read from its other end is the same view.
    assert distinct([square, np.roll(square, 2, axis=0)], 640, 60) == [0]


def test_outlines() -> None:
    board = Board.parse("charuco:9x7")
    pose = poses(1, board, PINHOLE_CAMERA)[0]
    ideal = PINHOLE_CAMERA.ideal()
    exact = truth(board, ideal, pose)
    part = np.arange(10, 30)  # the outermost corners are out of sight
    found = outline(board, View(part, exact[part]))
    assert found is not None
    np.testing.assert_allclose(found, exact[[0, 7, 47, 40]], atol=0.1)
    assert outline(board, View(np.arange(4), np.ones((4, 2)))) is None


def test_the_picture_shows_corners_and_gaps(views: list[View], result: Calibration) -> None:
    outlines = [outline(BOARD, view) for view in views]
    assert all(corners is not None for corners in outlines)
    picture = coverage.draw(views, outlines, 640, 480, result)  # type: ignore[arg-type]
    assert picture.shape == (480, 640, 3)
    for view in (views[k] for k in result.used[:3]):
        u, v = view.pixels[20].round().astype(int)
        _, green, red = picture[v, u].astype(int)
        assert green > red + 50
    one = replace(result, used=(0,), residuals=result.residuals[:1])
    gaps = coverage.draw(views[:1], outlines[:1], 640, 480, one)  # type: ignore[arg-type]
    empty = verdict.covered(views[:1], 640, 480) == 0
    row, column = np.argwhere(empty)[0]
    assert gaps[row * 120 + 60, column * 106 + 50].tolist() == [205, 205, 235]


def test_without_a_result_corners_are_neither_good_nor_bad(views: list[View]) -> None:
    outlines = [outline(BOARD, view) for view in views]
    picture = coverage.draw(views, outlines, 640, 480)  # type: ignore[arg-type]
    for view in views[:3]:
        u, v = view.pixels[20].round().astype(int)
        assert np.ptp(picture[v, u].astype(int)) < 20
        assert picture[v, u].max() < 200
    assert (picture == (205, 205, 235)).all(axis=2).any() == (verdict.covered(views, 640, 480) == 0).any()


@pytest.mark.parametrize("source", ["folder\nwidth: 3", "st\udce9r\udce9o", "a\x07bell", "\u2028width: 3"])
def test_what_is_written_is_read_back(source: str, result: Calibration) -> None:
    text = camera_text(result, 20, source, "chessboard:9x6").encode().decode()
    camera = parse_camera(text)
    assert (camera.width, camera.height, camera.model) == (640, 480, "pinhole")
    assert camera.fx == pytest.approx(result.camera.fx, abs=1e-6)
    assert camera.distortion == pytest.approx(result.camera.distortion, abs=1e-9)
    fisheye = replace(result, camera=FISHEYE_CAMERA)
    assert parse_camera(camera_text(fisheye, 20, "x", "y")) == FISHEYE_CAMERA


@pytest.mark.parametrize("readout_ms", [26.5, -15.0, 0.0, None])
def test_a_readout_is_written_where_one_is_known(result: Calibration, readout_ms: float | None) -> None:
    text = camera_text(result, 20, "x", "y", readout_ms)
    assert parse_camera(text).readout_ms == readout_ms
    assert ("readout_ms" in text) == (readout_ms is not None)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_focal_length_that_is_not_known_is_said_of_either(axis: int) -> None:
    views = seen(BOARD, PINHOLE_CAMERA, poses(20, BOARD, PINHOLE_CAMERA), 0.1)
    result = calibrate(BOARD, views, 640, 480, "pinhole")
    sigmas = result.sigmas.copy()
    sigmas[axis] = 0.02 * PINHOLE_CAMERA.fx
    (line,) = verdict.of_result(replace(result, sigmas=sigmas))
    assert "the focal length is known to 2.0% only" in line
