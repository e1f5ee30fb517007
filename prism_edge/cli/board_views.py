"""Looks for a calibration board in a recording or a live camera."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from prism_edge.calibration import verdict
from prism_edge.calibration.board import Board, View
from prism_edge.calibration.solve import calibrate
from prism_edge.calibration.views import distinct, outline
from prism_edge.errors import CalibrationError
from prism_edge.geometry.cameras import PINHOLE
from prism_edge.geometry.poses import Array
from prism_edge.sources import Image, Source

_LOOKED_AT = 300  # images of a recording, evenly chosen, that are searched
_SPACING_NS = 200_000_000  # between them where nobody knows how many there are
_SAID_EVERY_S = 5.0
_ENOUGH = 25  # different views at which a live camera is let go, if they cover the image and suffice
MOST = 60  # views that are used


@dataclass
class Gathered:
    """Views of the board, and the outline (4, 2) of each."""

    width: int = 0
    height: int = 0
    looked: int = 0  # images
    found: int = 0  # of them with the board; views that add nothing may be forgotten
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
        self.found += 1
        self.views.append(view)
        self.outlines.append(corners)
        return True

    def different(self) -> list[int]:
        """Indices of the views that differ from each other."""
        return distinct(self.outlines, self.width, MOST)


def gather(source: Source, board: Board, say: Callable[[str], None], model: str = PINHOLE) -> Gathered:
    """Views from an open source: all of a recording, or of a live camera until they suffice for a camera
    of this ``model``, or Ctrl-C."""
    gathered = Gathered()
    if source.live:
        say("move and tilt the board, also at the edges of the image; Ctrl-C ends it early")
        try:
            _watch(source, board, gathered, say, model)
        except KeyboardInterrupt:
            say("ended")
    else:
        _play(source, board, gathered, say)
    return gathered


def _play(source: Source, board: Board, gathered: Gathered, say: Callable[[str], None]) -> None:
    """Looks at a recording; a large image takes seconds, so that it is said how far that is."""
    said_s = time.monotonic()
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
        if time.monotonic() - said_s >= _SAID_EVERY_S:
            said_s = time.monotonic()
            of = f" of {math.ceil(source.frame_count / step)}" if source.frame_count and step else ""
            say(f"{gathered.looked}{of} images looked at, the board in {gathered.found}")


def _watch(
    source: Source, board: Board, gathered: Gathered, say: Callable[[str], None], model: str
) -> None:
    problem = ""
    while True:
        item = source.read()
        warning = source.health().get("warning", "")
        if warning != problem:
            problem = warning
            say(warning or "the camera is back")
        if not isinstance(item, Image) or not gathered.look(board, item):
            continue
        chosen, newest = gathered.different(), len(gathered.views) - 1
        # What adds nothing is forgotten at once: a camera may run for long.
        gathered.views = [gathered.views[k] for k in sorted(chosen)]
        gathered.outlines = [gathered.outlines[k] for k in sorted(chosen)]
        if newest not in chosen:
            continue
        enough = len(chosen) >= _ENOUGH
        wanting = _wanting(board, gathered, model if enough else None)
        say(f"{len(chosen)} views" + (f": {wanting[0]}" if wanting else ""))
        if enough and not wanting:
            return


def _wanting(board: Board, gathered: Gathered, model: str | None) -> list[str]:
    """What the views lack, and what a calibration by them would, where a ``model`` is given."""
    views, seen, width, height = gathered.views, gathered.found, gathered.width, gathered.height
    wanting = verdict.of_views(views, seen, width, height)
    if wanting or model is None:
        return wanting
    try:
        return verdict.of_calibration(views, seen, calibrate(board, views, width, height, model))
    except CalibrationError as error:
        return [str(error)]
