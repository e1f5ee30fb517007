"""A recording played again and again, as if it had no end."""

from __future__ import annotations

from dataclasses import replace

from prism_edge.geometry.poses import Array
from prism_edge.sources.base import Absent, Image, Slot, Source, Unreadable
from prism_edge.sources.wrapped import Wrapped


class Looped(Wrapped):
    """Starts again at the end, with indices and stamps that go on: one period after the last."""

    def __init__(self, source: Source) -> None:
        super().__init__(source)
        self.name, self.frame_count = f"{source.name}, looped", None
        self._index_offset = self._stamp_offset = 0
        self._passed: list[Slot] = []  # first, and newest so far, of this round
        self._round = 0, 0  # images and nanoseconds of a whole one; none before the first has ended

    def open(self) -> None:
        self._source.open()
        self.period_ns = self._source.period_ns  # a video knows it once it is open
        self._index_offset = self._stamp_offset = 0
        self._passed, self._round = [], (0, 0)

    def peek(self) -> Slot | None:
        slot = self._source.peek()
        if slot is None and self._passed:
            self._rewind()
            slot = self._source.peek()
        return slot and replace(
            slot, index=slot.index + self._index_offset, stamp_ns=slot.stamp_ns + self._stamp_offset
        )

    def read(self) -> Image | Unreadable | Absent | None:
        item = self._source.read()
        if item is None and self._passed:
            self._rewind()
            item = self._source.read()
        if item is None or isinstance(item, Absent):
            return item
        self._pass(Slot(item.index, item.stamp_ns, isinstance(item, Unreadable) and item.out_of_line))
        return replace(
            item, index=item.index + self._index_offset, stamp_ns=item.stamp_ns + self._stamp_offset
        )

    def skip(self) -> bool:
        slot = self._source.peek()
        skipped = self._source.skip()
        if not skipped and self._passed:
            self._rewind()
            slot = self._source.peek()
            skipped = self._source.skip()
        if skipped and slot is not None:
            self._pass(slot)
        return skipped

    def leap(self, index: int) -> int:
        images, length_ns = self._round
        slot = self.peek() if images else None
        rounds = 0 if slot is None else max(index - slot.index, 0) // images
        self._index_offset += rounds * images
        self._stamp_offset += rounds * length_ns
        return rounds * images

    def true_pose(self, index: int) -> Array | None:
        """Of an image of this round; the worker asks right after it has read it."""
        return self._source.true_pose(index - self._index_offset)

    def _pass(self, slot: Slot) -> None:
        first, newest = self._passed or (slot, slot)
        if first.out_of_line:  # its index counts, its time doesn't
            first, newest = replace(slot, index=first.index), slot
        stamp_ns = newest.stamp_ns if slot.out_of_line else max(slot.stamp_ns, newest.stamp_ns)
        self._passed = [first, Slot(slot.index, stamp_ns)]

    def _rewind(self) -> None:
        first, newest = self._passed
        self._round = newest.index - first.index + 1, newest.stamp_ns - first.stamp_ns + self.period_ns
        self._index_offset += self._round[0]
        self._stamp_offset += self._round[1]
        self._passed = []
        self._source.close()
        self._source.open()
