"""Stamps of a live camera: the wall clock as it stood at the start, going on evenly whatever becomes of it.

The monotonic clock stands still while the computer sleeps; all other clocks of the robot go on.
"""

from __future__ import annotations

import logging
import time

log = logging.getLogger("prism_edge.sources")

NOTICEABLE_NS = 100_000_000  # reading two clocks takes less than that, and no computer sleeps for less


class WallClock:
    """The time of day (ns since 1970) of moments on the monotonic clock."""

    def __init__(self) -> None:
        self._ahead_ns = time.time_ns() - time.monotonic_ns()
        self._slept_ns = _slept_ns()

    def at(self, monotonic_ns: int) -> int:
        """Of a moment since this object was made; after a sleep, those of before are later by its length."""
        slept_ns = _slept_ns() - self._slept_ns
        if slept_ns > NOTICEABLE_NS:
            self._ahead_ns += slept_ns
            self._slept_ns += slept_ns
            log.warning("the computer has slept for %.1f s: stamps go on by as much", slept_ns * 1e-9)
        return monotonic_ns + self._ahead_ns


def since_boot_ns(monotonic_ns: int) -> int:
    """A moment on the clock that goes on while the computer sleeps, and that nobody sets."""
    return monotonic_ns + _slept_ns()


def _slept_ns() -> int:
    """For how long the computer has slept since its start; 0 where no clock says so."""
    clock = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
    return time.clock_gettime_ns(clock) - time.clock_gettime_ns(time.CLOCK_MONOTONIC)
