"""Culled keyframes that are remembered by their pose alone: columns, so that thousands take little memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array

_FIRST = 64  # rows to begin with


class Carried:
    """The ``most`` culled last, each hung on a keyframe that is there; oldest first."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._begin = self._end = 0
        self._numbers = np.zeros((_FIRST, 3), np.int64)  # culled keyframe, the one it hangs on, frame
        self._links = np.zeros((_FIRST, 3, 4))

    def __len__(self) -> int:
        return self._end - self._begin

    @property
    def numbers(self) -> NDArray[np.int64]:
        """(n, 3): culled keyframe, the keyframe it hangs on, its frame."""
        return self._numbers[self._begin : self._end]

    @property
    def ids(self) -> NDArray[np.int64]:
        """(n,): the culled keyframes."""
        return self.numbers[:, 0]

    @property
    def links(self) -> Array:
        """(n, 4, 4) keyframe_from_culled, a copy."""
        links = np.zeros((len(self), 4, 4))
        links[:, :3], links[:, 3, 3] = self._links[self._begin : self._end], 1.0
        return links

    def add(self, culled: int, anchor: int, link: Array, frame: int) -> None:
        """Remember one more; the oldest goes where that is one too many."""
        if not self._most:
            return
        if self._end == len(self._numbers):
            self._make_room()
        self._numbers[self._end] = culled, anchor, frame
        self._links[self._end] = link[:3]
        self._end += 1
        if len(self) > self._most:
            self._begin += 1

    def rehang(self, gone: int, anchor: int, link: Array) -> None:
        """What hung on a keyframe that is culled hangs on another now; ``link`` is anchor_from_gone."""
        rows = self._begin + np.flatnonzero(self.numbers[:, 1] == gone)
        if len(rows):
            self._links[rows] = link[:3, :3] @ self._links[rows]
            self._links[rows, :, 3] += link[:3, 3]
            self._numbers[rows, 1] = anchor

    def drop(self, gone: int) -> None:
        """What hung on a keyframe has no place any more."""
        kept = self.numbers[:, 1] != gone
        numbers, links = self.numbers[kept], self._links[self._begin : self._end][kept]
        self._end = self._begin + len(numbers)
        self._numbers[self._begin : self._end], self._links[self._begin : self._end] = numbers, links

    def stretch(self, anchor: int, factor: float) -> None:
        """Lengths about a keyframe are so many times as long now, also to what hangs on it."""
        self._links[self._begin + np.flatnonzero(self.numbers[:, 1] == anchor), :, 3] *= factor

    def _make_room(self) -> None:
        """Move to the front where many of the oldest have gone, else to columns twice as large."""
        count, size = len(self), len(self._numbers)
        if self._begin < size // 4:
            size *= 2
        for name in ("_numbers", "_links"):
            column = getattr(self, name)
            room = np.zeros((size, *column.shape[1:]), column.dtype)
            room[:count] = column[self._begin : self._end]
            setattr(self, name, room)
        self._begin, self._end = 0, count
