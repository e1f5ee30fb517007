"""When the images of a recording are due in real time (pure)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from prism_edge.sources.base import Slot

GAP = "next_image_s"  # on `health` while a pause in the stamps is waited for
_ROW = 10  # images: one that takes long to decode says nothing yet


@dataclass(frozen=True)
class Schedule:
    """Image i is due at start + (its stamp - the first's), or i / rate where a rate is set.

    Times are integer nanoseconds of the host's monotonic clock.
    """

    start_ns: int
    first: Slot
    period_ns: int
    rate_hz: float = 0.0

    def due_ns(self, slot: Slot) -> int:
        """The image's release, which is taken as its moment of capture."""
        if self.rate_hz:
            return self.start_ns + round((slot.index - self.first.index) * 1e9 / self.rate_hz)
        return self.start_ns + slot.stamp_ns - self.first.stamp_ns

    def periods_late(self, slot: Slot, now_ns: int) -> float:
        """By how many periods the image is overdue; less than zero ahead of its time."""
        period_ns = round(1e9 / self.rate_hz) if self.rate_hz else self.period_ns
        return (now_ns - self.due_ns(slot)) / period_ns

    def is_late(self, slot: Slot, now_ns: int) -> bool:
        """Whether the image is more than one period overdue, so that the one after it is due too."""
        return self.periods_late(slot, now_ns) > 1.0

    def put_off(self, by_ns: int) -> Schedule:
        """All that is due from now on is due later by this."""
        return replace(self, start_ns=self.start_ns + by_ns)


class CatchingUp:
    """Whether skipping late images gains time, where each costs about what reading it does.

    It is given up for good once a row of as many images as it was periods late has not halved that.
    """

    def __init__(self) -> None:
        self.given_up = False
        self._next = -1  # the index that goes on with the row
        self._left = 0
        self._late = 0.0  # periods, when the row began

    def skips(self, index: int, late: float) -> bool:
        """Whether to skip the image, overdue by ``late`` periods (above 1)."""
        in_row = index == self._next
        if in_row and self._left == 0 and late > self._late / 2:
            self.given_up = True
        if self.given_up:
            return False
        if not in_row or self._left == 0:
            self._left, self._late = max(math.ceil(late), _ROW), late
        self._left -= 1
        self._next = index + 1
        return True
