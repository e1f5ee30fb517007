"""A sender's stamps in this host's time, by the smallest delay seen lately (pure)."""

from __future__ import annotations

from collections import deque

_WINDOW_NS = 30_000_000_000
_JUMP_NS = 10_000_000_000
_BACK_NS = 500_000_000  # pictures that are sent out of order lie closer than this


class ArrivalClock:
    """Maps stamps of a camera's clock to the host's monotonic clock (nanoseconds both).

    An image arrives when it was taken, plus the least time it can take, plus what the network adds.
    The smallest (arrival - stamp) of the last 30 s is the one to which the network added least, so
    stamp + that is free of the network's jitter. It is late by the least delay, which can't be seen
    from here, and early by what the clocks drift apart in the window: 3 ms at 100 ppm.

    A sender that starts its stamps anew (they go back by more than 0.5 s, or leap by more than 10 s
    against the arrivals) is taken as a new clock.
    """

    def __init__(self, window_ns: int = _WINDOW_NS) -> None:
        self._window_ns = window_ns
        # (arrival, arrival - stamp): the smallest first, then the smallest of those that came after it
        self._least: deque[tuple[int, int]] = deque()
        self._newest: tuple[int, int] | None = None  # stamp and offset

    def observe(self, stamp_ns: int, arrival_ns: int) -> None:
        """An image stamped by the sender has arrived."""
        offset = arrival_ns - stamp_ns
        if self._newest is not None:
            stamp, before = self._newest
            if stamp_ns < stamp - _BACK_NS or abs(offset - before) > _JUMP_NS:
                self._least.clear()
        self._newest = stamp_ns, offset
        while self._least and self._least[-1][1] >= offset:
            self._least.pop()
        self._least.append((arrival_ns, offset))
        while self._least[0][0] < arrival_ns - self._window_ns:
            self._least.popleft()

    def host_ns(self, stamp_ns: int) -> int:
        """Host's time of a stamp near those observed; ValueError before the first."""
        if not self._least:
            raise ValueError("nothing has been observed yet")
        return stamp_ns + self._least[0][1]
