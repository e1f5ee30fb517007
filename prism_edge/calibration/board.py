"""The board: what is printed on it, and where its corners are seen in an image."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.errors import ConfigError
from prism_edge.geometry.poses import Array
from prism_edge.messages import I64, U8

CHESSBOARD, CHARUCO = "chessboard", "charuco"
EXAMPLES = "chessboard:9x6 (inner corners) or charuco:7x5,4X4_50,0.75 (squares, dictionary, marker/square)"

_DICTIONARY, _MARKER = "4X4_50", 0.75
_MOST = 50
_QUIET = cv2.utils.logging.LOG_LEVEL_ERROR  # OpenCV warns of markers that nearly fill their squares
_WINDOW = 0.4  # of a square, each way at most: what a corner is made sharper in
_BENT = 0.1  # pixels: how far the lens may bend an edge away in there, or the corner follows it
_SHARP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
_LEAST_CORNERS = 8  # of a board that is seen in part; fewer hardly tell its pose


@dataclass(frozen=True)
class View:
    """Corners of the board in one image."""

    corners: I64  # (n,) which, from 0
    pixels: Array  # (n, 2) where


@dataclass(frozen=True)
class Board:
    """A chessboard by its inner corners, or a ChArUco board by its squares. A square has side 1.

    The intrinsics don't depend on the size of the squares, so nobody need measure them.
    """

    kind: str
    columns: int
    rows: int
    dictionary: str = _DICTIONARY
    marker: float = _MARKER  # side of a marker, of that of a square

    @classmethod
    def parse(cls, text: str) -> Board:
        """The board that a command line names; raises ConfigError."""
        kind, _, rest = text.partition(":")
        size, *more = rest.split(",")
        match = re.fullmatch(r"(\d{1,3})x(\d{1,3})", size)
        if kind not in (CHESSBOARD, CHARUCO) or match is None or len(more) > (2 if kind == CHARUCO else 0):
            raise ConfigError(f"board {text!r} is not known; write {EXAMPLES}")
        columns, rows = int(match[1]), int(match[2])
        if min(columns, rows) < 3 or max(columns, rows) > _MOST:
            raise ConfigError(f"board {text!r}: 3 to {_MOST} each way")
        corners = (columns - 1) * (rows - 1)
        if kind == CHARUCO and corners < _LEAST_CORNERS:
            raise ConfigError(f"board {text!r}: {corners} inner corners, and {_LEAST_CORNERS} are needed")
        dictionary = more[0].upper().removeprefix("DICT_") if more else _DICTIONARY
        if not hasattr(cv2.aruco, f"DICT_{dictionary}"):
            raise ConfigError(f"board {text!r}: dictionary {dictionary} is not known (4X4_50, 5X5_100, ...)")
        try:
            marker = float(more[1]) if len(more) > 1 else _MARKER
        except ValueError:
            marker = 0.0
        if not 0.2 <= marker <= 0.95:
            raise ConfigError(f"board {text!r}: marker/square is a number from 0.2 to 0.95")
        board = cls(kind, columns, rows, dictionary, marker)
        if kind == CHARUCO and columns * rows // 2 > len(board._markers.bytesList):
            raise ConfigError(f"board {text!r}: {dictionary} has too few markers for it")
        return board

    @cached_property
    def points(self) -> Array:
        """All corners on the board (n, 3), in squares; z is 0."""
        columns, rows = self._corners
        y, x = np.mgrid[:rows, :columns]
        return np.stack([x.ravel(), y.ravel(), np.zeros(columns * rows)], axis=1).astype(np.float64)

    @property
    def outline(self) -> Array:
        """The outermost corners (4, 2) on the board, in squares, one after the other."""
        columns, rows = self._corners
        return np.array([[0, 0], [columns - 1, 0], [columns - 1, rows - 1], [0, rows - 1]], dtype=np.float64)

    def find(self, pixels: U8) -> View | None:
        """Its corners in an image: grey (h, w) or BGR (h, w, 3); None where it can't be seen (enough)."""
        grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
        return self._find_charuco(grey) if self.kind == CHARUCO else self._find_chessboard(grey)

    @property
    def _corners(self) -> tuple[int, int]:
        inner = 1 if self.kind == CHARUCO else 0
        return self.columns - inner, self.rows - inner

    @cached_property
    def _markers(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))

    @cached_property
    def _detectors(self) -> tuple[cv2.aruco.CharucoDetector, ...]:
        """For boards whose first square is black, and for those of before OpenCV 4.6, where it was white."""
        cv2.utils.logging.setLogLevel(_QUIET)
        detectors = []
        for legacy in (False, True):
            board = cv2.aruco.CharucoBoard((self.columns, self.rows), 1.0, self.marker, self._markers)
            board.setLegacyPattern(legacy)
            detectors.append(cv2.aruco.CharucoDetector(board))
        return tuple(detectors)

    def _find_chessboard(self, grey: U8) -> View | None:
        found, pixels = cv2.findChessboardCornersSB(grey, (self.columns, self.rows), flags=0)
        if not found:
            return None
        # What finds the board puts some corners a pixel or two aside, most of them at its rim.
        half = max(2, int(min(_WINDOW * self._least_step(pixels), math.sqrt(2 * _BENT / self._bend(pixels)))))
        pixels = cv2.cornerSubPix(grey, pixels, (half, half), (-1, -1), _SHARP)
        return View(np.arange(len(self.points), dtype=np.int64), pixels.reshape(-1, 2).astype(np.float64))

    def _least_step(self, pixels: NDArray[np.float32]) -> float:
        """Pixels between the nearest two neighbours among all corners (n, 1, 2)."""
        grid = pixels.reshape(self.rows, self.columns, 2)
        return float(min(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)))

    def _bend(self, pixels: NDArray[np.float32]) -> float:
        """How much the lens bends the board's lines (n, 1, 2): upper quartile of their 1 / radius."""
        grid, found = pixels.reshape(self.rows, self.columns, 2), []
        for line in (grid, grid.transpose(1, 0, 2)):
            along, across = line[2:] - line[:-2], line[2:] - 2 * line[1:-1] + line[:-2]
            aside = np.abs(along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0])
            found.append(4 * aside / np.maximum(np.linalg.norm(along, axis=2), 1e-6) ** 3)
        return max(float(np.quantile(np.concatenate([a.ravel() for a in found]), 0.75)), 1e-9)

    def _find_charuco(self, grey: U8) -> View | None:
        for detector in self._detectors:
            pixels, corners, _, markers = detector.detectBoard(grey)
            if corners is not None and len(corners) >= _LEAST_CORNERS and self._is_spread(corners.ravel()):
                return View(corners.ravel().astype(np.int64), pixels.reshape(-1, 2).astype(np.float64))
            if markers is None or len(markers) < _LEAST_CORNERS // 2:
                return None
        return None

    def _is_spread(self, corners: I64) -> bool:
        """Whether the corners are more than one line of the board, which would not tell its pose."""
        at = self.points[corners]
        return bool(np.ptp(at[:, 0]) >= 1 and np.ptp(at[:, 1]) >= 1)
