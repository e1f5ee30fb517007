"""The first frames of a recording, as if it ended there."""

from __future__ import annotations

from prism_edge.sources.base import Absent, Image, Slot, Source, Unreadable
from prism_edge.sources.wrapped import Wrapped


class Beginning(Wrapped):
    """Of another source what it gives at the indices below ``frames``, unreadable ones included."""

    def __init__(self, source: Source, frames: int) -> None:
        super().__init__(source)
        self.name, self._frames = f"{source.name}, its first {frames} frames", frames
        self._learn()

    def open(self) -> None:
        self._source.open()
        self._learn()

    def _learn(self) -> None:
        """A video knows these once it is open."""
        self.period_ns = self._source.period_ns
        count = self._source.frame_count
        self.frame_count = None if count is None else min(count, self._frames)

    def peek(self) -> Slot | None:
        slot = self._source.peek()
        return slot if slot is not None and slot.index < self._frames else None

    def read(self) -> Image | Unreadable | Absent | None:
        return None if self.peek() is None else self._source.read()

    def skip(self) -> bool:
        return self.peek() is not None and self._source.skip()
