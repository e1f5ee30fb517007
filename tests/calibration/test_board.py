"""Boards: their names, and their corners in pictures of which every ray is known."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.calibration.board import Board, View
from prism_edge.errors import ConfigError
from tests.calibration.board_scene import FISHEYE_CAMERA, PINHOLE_CAMERA, draw, gallery, poses, truth


def test_names() -> None:
    assert Board.parse("chessboard:9x6") == Board("chessboard", 9, 6)
    assert Board.parse("charuco:7x5") == Board("charuco", 7, 5, "4X4_50", 0.75)
    assert Board.parse("charuco:11x8,dict_5x5_100,0.8") == Board("charuco", 11, 8, "5X5_100", 0.8)
    assert Board.parse("chessboard:3x50") == Board("chessboard", 3, 50)
    assert len(Board.parse("chessboard:9x6").points) == 54
    assert len(Board.parse("charuco:7x5").points) == 24
    small = Board.parse("charuco:7x5,4X4_50,0.5")._detectors
    assert [detector.getBoard().getMarkerLength() for detector in small] == [0.5, 0.5]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "9x6",
        "chess:9x6",
        "chessboard:9",
        "chessboard:9x",
        "chessboard:2x6",
        "chessboard:9x600",
        "chessboard:9x6,4X4_50",
        "charuco:7x5,9X9_50",
        "charuco:3x4",  # six corners, of which none are enough
        "charuco:7x5,4X4_50,big",
        "charuco:7x5,4X4_50,2",
        "charuco:7x5,4X4_50,0.1",
        "charuco:7x5,4X4_50,0.7,1",
        "charuco:20x20,4X4_50",
    ],
)
def test_names_that_are_none(text: str) -> None:
    with pytest.raises(ConfigError) as error:
        Board.parse(text)
    assert "\n" not in str(error.value)


_NAMES = st.text(alphabet="x0123456789,X_.DICT", max_size=20)


@given(st.text(max_size=30) | _NAMES.map("charuco:".__add__) | _NAMES.map("charuco:7x5,".__add__))
def test_any_name_is_a_board_or_a_config_error(text: str) -> None:
    with contextlib.suppress(ConfigError):
        assert Board.parse(text).columns >= 3


@pytest.mark.parametrize("camera", [PINHOLE_CAMERA, FISHEYE_CAMERA], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("spec", ["chessboard:9x6", "charuco:9x7"])
def test_corners_are_found_where_they_are(spec: str, camera) -> None:  # type: ignore[no-untyped-def]
    board = Board.parse(spec)
    misses, worst = [], []
    for pose, image in zip(*gallery(spec, camera), strict=True):
        view = board.find(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        if view is None:
            continue
        exact = truth(board, camera, pose)[view.corners]
        # A chessboard may be read from either end.
        ways = [exact, exact[::-1]] if board.kind == "chessboard" else [exact]
        found = min((np.linalg.norm(view.pixels - way, axis=1) for way in ways), key=np.mean)
        misses.append(float(found.mean()))
        worst.append(float(found.max()))
    assert len(misses) >= 14
    assert np.median(misses) < 0.15
    assert max(misses) < 0.5
    if board.kind == "chessboard":  # one that lies a pixel aside bends the lens that is found
        assert max(worst) < 0.3


def test_the_edges_of_large_squares_are_followed_only_while_they_are_straight() -> None:
    """Under a fisheye they bend away from a corner by more than it is to be off."""
    camera, board = FISHEYE_CAMERA, Board.parse("chessboard:5x4")
    for k, pose in enumerate(poses(4, board, camera)):
        view, there = board.find(draw(board, camera, pose, k)), truth(board, camera, pose)
        assert view is not None
        assert min(np.abs(view.pixels - other).max() for other in (there, there[::-1])) < 0.12


def test_a_charuco_board_may_be_seen_in_part() -> None:
    board = Board.parse("charuco:9x7")
    pose, image = (items[0] for items in gallery("charuco:9x7", PINHOLE_CAMERA))
    exact = truth(board, PINHOLE_CAMERA, pose)
    half = image.copy()
    half[:, round(exact[:, 0].mean()) :] = 128
    view = board.find(half)
    assert view is not None
    assert 8 <= len(view.corners) < 0.6 * len(exact)
    assert np.linalg.norm(view.pixels - exact[view.corners], axis=1).max() < 0.5


def test_a_board_printed_by_an_older_opencv() -> None:
    old = cv2.aruco.CharucoBoard((6, 8), 1.0, 0.75, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    old.setLegacyPattern(True)
    image = cv2.copyMakeBorder(old.generateImage((360, 480)), 30, 30, 30, 30, cv2.BORDER_CONSTANT, value=255)
    view = Board.parse("charuco:6x8").find(image)
    assert view is not None
    assert len(view.corners) == 35


def test_of_markers_that_nearly_fill_their_squares_nothing_is_said(capfd: pytest.CaptureFixture[str]) -> None:
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_WARNING)  # OpenCV's own, whatever ran before
    assert Board.parse("charuco:7x5,4X4_50,0.95").find(np.zeros((48, 64), np.uint8)) is None
    assert capfd.readouterr().err == ""


def test_nothing_is_found_where_nothing_is() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (120, 160), dtype=np.uint8)
    for spec in ("chessboard:9x6", "charuco:7x5"):
        assert Board.parse(spec).find(noise) is None
        assert Board.parse(spec).find(np.zeros((48, 64, 3), np.uint8)) is None
    # Another board than the one named.
    _, images = gallery("chessboard:9x6", PINHOLE_CAMERA)
    assert Board.parse("charuco:7x5").find(images[0]) is None


@pytest.mark.parametrize(
    ("corners", "enough"), [(range(5, 12), False), (range(11), False), (range(5, 13), True)]
)
def test_a_few_corners_and_one_line_of_them_are_not_enough(corners: range, enough: bool) -> None:
    board = Board.parse("charuco:12x4")
    found = np.zeros((len(corners), 1, 2)), np.array(corners)[:, None], None, np.zeros((9, 1))
    board.__dict__["_detectors"] = (SimpleNamespace(detectBoard=lambda grey: found),)
    assert (board.find(np.zeros((48, 64), np.uint8)) is not None) is enough


def test_one_line_of_a_board_is_no_view() -> None:
    board = Board.parse("charuco:12x4")
    assert not board._is_spread(np.arange(11))
    assert not board._is_spread(np.arange(0, 33, 11))
    assert board._is_spread(np.arange(12))
    assert View(np.arange(2), np.zeros((2, 2))).pixels.shape == (2, 2)
