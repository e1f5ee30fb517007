"""Looks for a calibration board in a recording or a live camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from prism_edge.calibration import verdict
from prism_edge.calibration.board import Board, View
from prism_edge.calibration.views import distinct, outline
from prism_edge.errors import CalibrationError
from prism_edge.geometry.poses import Array
from prism_edge.sources import Image, Source

_LOOKED_AT = 300  # images of a recording, evenly chosen, that are searched
_SPACING_NS = 200_000_000  # between them where nobody knows how many there are
_ENOUGH = 25  # different views at which a live camera is let go, if they cover the image
MOST = 60  # views that are used


@dataclass
class Gathered:
    """Views of the board, and the outline (4, 2) of each."""

    width: int = 0
    height: int = 0
    looked: int = 0
    views: list[View] = field(default_factory=list)
    outlines: list[Array] = field(default_factory=list)

    def look(self, board: Board, image: Image) -> bool:
        """Whether the board was found in the image."""
        height, width = image.pixels.shape[:2]
        if self.looked and (width, height) != (self.width, self.height):
            raise CalibrationError(
                f"the images differ in size ({self.width}x{self.height}, then {width}x{height}): "
                "a camera file is for one size"
            )
        self.width, self.height = width, height
        self.looked += 1
        view = board.find(image.pixels)
        corners = None if view is None else outline(board, view)
        if view is None or corners is None:
            return False
        self.views.append(view)
        self.outlines.append(corners)
        return True

    def different(self) -> list[int]:
        """Indices of the views that differ from each other."""
        return distinct(self.outlines, self.width, MOST)


def gather(source: Source, board: Board, say: Callable[[str], None]) -> Gathered:
    """Views from an open source: all of a recording, or of a live camera until they suffice or Ctrl-C."""
    gathered = Gathered()
    if source.live:
        say("move and tilt the board, also at the edges of the image; Ctrl-C ends it early")
        try:
            _watch(source, board, gathered, say)
        except KeyboardInterrupt:
            say("ended")
    else:
        _play(source, board, gathered)
    return gathered


def _play(source: Source, board: Board, gathered: Gathered) -> None:
    step = math.ceil((source.frame_count or 0) / _LOOKED_AT)
    next_ns: int | None = None
    while (slot := source.peek()) is not None:
        due = slot.index % step == 0 if step else next_ns is None or slot.stamp_ns >= next_ns
        if not due:
            source.skip()
            continue
        next_ns = slot.stamp_ns + _SPACING_NS
        item = source.read()
        if isinstance(item, Image):
            gathered.look(board, item)


def _watch(source: Source, board: Board, gathered: Gathered, say: Callable[[str], None]) -> None:
    count, problem = 0, ""
    while True:
        item = source.read()
        warning = source.health().get("warning", "")
        if warning != problem:
            problem = warning
            say(warning or "the camera is back")
        if not isinstance(item, Image) or not gathered.look(board, item):
            continue
        chosen = gathered.different()
        # What adds nothing is forgotten at once: a camera may run for long.
        gathered.views = [gathered.views[k] for k in sorted(chosen)]
        gathered.outlines = [gathered.outlines[k] for k in sorted(chosen)]
        if len(chosen) == count:
            continue
        count = len(chosen)
        wanting = verdict.of_views(gathered.views, count, gathered.width, gathered.height)
        say(f"{count} views" + (f": {wanting[0]}" if wanting else ""))
        if count >= _ENOUGH and not wanting:
            return
