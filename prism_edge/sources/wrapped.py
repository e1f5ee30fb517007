"""Another source, passed on as it is: what is made of one by another kind says only what it changes."""

from __future__ import annotations

import threading

from prism_edge.geometry.poses import Array
from prism_edge.sources.base import Absent, Image, Slot, Source, Unreadable


class Wrapped(Source):
    """What ``source`` says and gives."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.name, self.camera, self.camera_origin = source.name, source.camera, source.camera_origin
        self.frame_count, self.period_ns = source.frame_count, source.period_ns
        self.live, self.synthetic = source.live, source.synthetic
        self.decodes_skipped = source.decodes_skipped

    def open(self) -> None:
        self._source.open()

    def peek(self) -> Slot | None:
        return self._source.peek()

    def read(self) -> Image | Unreadable | Absent | None:
        return self._source.read()

    def skip(self) -> bool:
        return self._source.skip()

    def leap(self, index: int) -> int:
        return self._source.leap(index)

    @property
    def connecting_s(self) -> float:
        return self._source.connecting_s

    def stop_on(self, stopped: threading.Event) -> None:
        self._source.stop_on(stopped)

    def read_ahead(self) -> None:
        self._source.read_ahead()

    def true_pose(self, index: int) -> Array | None:
        return self._source.true_pose(index)

    def health(self) -> dict[str, str]:
        return self._source.health()

    def close(self) -> None:
        self._source.close()
