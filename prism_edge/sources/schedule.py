"""When the images of a recording are due in real time (pure)."""

from __future__ import annotations

from dataclasses import dataclass

from prism_edge.sources.base import Slot


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

    def is_late(self, slot: Slot, now_ns: int) -> bool:
        """Whether the image is more than one period overdue, so that the one after it is due too."""
        period_ns = round(1e9 / self.rate_hz) if self.rate_hz else self.period_ns
        return now_ns - self.due_ns(slot) > period_ns
