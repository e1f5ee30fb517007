"""Keyframes that wait to join the map, and what has come of each: its depth, its gate and its scale."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable

from prism_edge.messages import Depth, Gate, Keyframe

# Real time: how long a keyframe waits for its depth and gate before its window is solved without.
DEPTH_WAIT_S = 0.25


class Arrivals:
    """In the order of keyframes' numbers, whichever of a keyframe's messages comes first."""

    def __init__(self, peers: Iterable[str], use_depth: bool) -> None:
        """``peers`` say which messages there are; ``use_depth``: whether a keyframe waits for its depth."""
        self._has_depth, self._has_scale = "depth" in peers, "scale" in peers
        self._use_depth = use_depth
        self._waiting: deque[tuple[float, Keyframe]] = deque()  # since when
        self._depths: dict[int, Depth] = {}
        self._gates: dict[int, Gate] = {}
        self._scales: set[int] = set()
        self._gone = -1  # the newest keyframe of a map that another has taken the place of

    def __len__(self) -> int:
        """How many keyframes wait."""
        return len(self._waiting)

    def keyframe(self, keyframe: Keyframe) -> None:
        """One of the present map, or of one that is still to begin."""
        self._waiting.append((time.monotonic(), keyframe))

    def is_gone(self, keyframe: Keyframe) -> None:
        """One of a map that is gone waits for nothing, and nobody for it."""
        self._gone = max(self._gone, keyframe.id)

    def depth(self, depth: Depth) -> None:
        """Of a keyframe that has not joined the map yet."""
        self._depths[depth.keyframe] = depth

    def gate(self, gate: Gate) -> None:
        self._gates[gate.keyframe] = gate

    def scale(self, keyframe: int) -> None:
        """A keyframe's scale has been heard."""
        self._scales.add(keyframe)

    def next(self, patient: bool) -> Keyframe | None:
        """The oldest keyframe that waits; None where it is to wait on, which it does for a while at most.

        ``patient``: for its depth and its gate.
        """
        if not self._waiting:
            return None
        arrived, keyframe = self._waiting[0]
        missing = self._use_depth and not {keyframe.id} <= self._depths.keys() & self._gates.keys()
        if patient and missing and time.monotonic() - arrived < DEPTH_WAIT_S:
            return None
        self._waiting.popleft()
        return keyframe

    def until(self, number: int) -> Keyframe | None:
        """The oldest keyframe that waits and is no newer than ``number``."""
        return self.next(False) if self._waiting and self._waiting[0][1].id <= number else None

    def complete(self, number: int) -> bool:
        """Whether a keyframe and all that belongs to it is there, or none of it will be wanted."""
        here = any(waiting.id == number for _, waiting in self._waiting)
        has_depth = not self._has_depth or number in self._depths
        has_scale = not self._has_scale or (number in self._scales and number in self._gates)
        return number <= self._gone or (here and has_depth and has_scale)

    def take(self, number: int) -> tuple[Depth | None, Gate | None]:
        """A keyframe joins the map: what came of it before it did. What came of older ones is forgotten."""
        depth, gate = self._depths.pop(number, None), self._gates.pop(number, None)
        self._depths = {k: kept for k, kept in self._depths.items() if k > number}
        self._gates = {k: kept for k, kept in self._gates.items() if k > number}
        self._scales = {k for k in self._scales if k > number}
        return depth, gate

    def begin(self, epoch: int) -> None:
        """A new map: keyframes of earlier ones wait no more."""
        self._waiting = deque((at, keyframe) for at, keyframe in self._waiting if keyframe.epoch >= epoch)

    def give_up(self) -> None:
        """Another map has been taken up: whatever waits is of the one before."""
        for _, keyframe in self._waiting:
            self.is_gone(keyframe)
        self._waiting.clear()
