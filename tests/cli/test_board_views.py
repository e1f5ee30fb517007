"""Which images a board is looked for in, and what is said before a live camera."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from prism_edge.calibration import verdict
from prism_edge.calibration.board import Board
from prism_edge.cli import board_views
from prism_edge.cli.board_views import Gathered, gather
from prism_edge.errors import CalibrationError
from prism_edge.sources.base import Image, Slot, Unreadable

PERIOD_NS = 33_333_333
NOWHERE: Any = SimpleNamespace(find=lambda pixels: None)  # a board that is in no image


class Recording:
    """Images of nothing, of which the third can't be read; remembers which were decoded."""

    live = False

    def __init__(self, frames: int, frame_count: int | None) -> None:
        self.frame_count, self.decoded = frame_count, list[int]()
        self._frames, self._next = frames, 0

    def peek(self) -> Slot | None:
        return Slot(self._next, self._next * PERIOD_NS) if self._next < self._frames else None

    def skip(self) -> None:
        self._next += 1

    def read(self) -> Image | Unreadable:
        k, self._next = self._next, self._next + 1
        self.decoded.append(k)
        if k == 2:
            return Unreadable(k, k * PERIOD_NS, "damaged")
        return Image(k, k * PERIOD_NS, np.zeros((4, 4), np.uint8))


@pytest.mark.parametrize(
    ("frames", "count", "read"),
    [
        (300, 300, range(300)),
        (301, 301, range(0, 301, 2)),
        (900, 900, range(0, 900, 3)),
        (20, None, (0, 7, 14)),  # where nobody knows how many there are, a fifth of a second apart
    ],
)
def test_no_more_of_a_recording_is_searched_than_shows_its_views(
    frames: int, count: int | None, read: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    source: Any = Recording(frames, count)
    said: list[str] = []
    monkeypatch.setattr(board_views, "_SAID_EVERY_S", 0.0)
    gathered = gather(source, NOWHERE, said.append)
    assert source.decoded == list(read)
    of = f" of {len(read)}" if count else ""
    assert said[-1] == f"{gathered.looked}{of} images looked at, the board in 0"
    assert gathered.looked == len(read) - (2 in read)
    assert gathered.found == 0


def test_a_camera_that_goes_away_and_comes_back_is_said_once_each() -> None:
    warnings = iter(["", "no image for 2 s", "no image for 2 s", "", "", "gone", KeyboardInterrupt()])

    def health() -> dict[str, str]:
        warning = next(warnings)
        if isinstance(warning, KeyboardInterrupt):
            raise warning
        return {"warning": warning} if warning else {}

    camera: Any = SimpleNamespace(live=True, read=lambda: None, health=health)
    said: list[str] = []
    gather(camera, NOWHERE, said.append)
    assert said[1:] == ["no image for 2 s", "the camera is back", "gone", "ended"]


@pytest.mark.parametrize(("model", "lacking"), [("pinhole", ["no pinhole fits"]), (None, [])])
def test_views_that_can_not_be_solved_for_do_not_end_a_live_search(
    model: str | None, lacking: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def calibrate(board: Board, views: Any, width: int, height: int, model: str) -> None:
        raise CalibrationError(f"no {model} fits")

    monkeypatch.setattr(verdict, "of_views", lambda *_: [])
    monkeypatch.setattr(board_views, "calibrate", calibrate)
    assert board_views._wanting(Board.parse("chessboard:9x6"), Gathered(640, 480), model) == lacking
