"""A sender's stamps in this host's time, by the smallest delay seen lately (pure)."""

from __future__ import annotations

from collections import deque

_WINDOW_NS = 30_000_000_000
_JUMP_NS = 10_000_000_000
_BACK_NS = 500_000_000  # pictures that are sent out of order lie closer than this
# So long no image has come within so much of the least delay: it is another by now. Once that may be the
# network, or a step of the sender's; time after time, and never back, its stamps run slower than time.
_RECENT_NS, _RISE_NS, _RISES = 5_000_000_000, 20_000_000, 3
_QUEUED = 5  # images in a row; two may come together


class ArrivalClock:
    """Maps stamps of a camera's clock to the host's monotonic clock (nanoseconds both).

    An image arrives when it was taken, plus the least time it can take, plus what the network adds.
    The smallest (arrival - stamp) of the last 30 s is the one to which the network added least, so
    stamp + that is free of the network's jitter. It is late by the least delay, which can't be seen
    from here, and early by what the clocks drift apart in the window: 3 ms at 100 ppm. Where they part by
    more than 20 ms, only the last 5 s count, and an encoder that counts 30 images to a second of 29 is found.

    A sender that starts its stamps anew (they go back by more than 0.5 s, or leap by more than 10 s
    against the arrivals) is taken as a new clock.
    """

    def __init__(self, window_ns: int = _WINDOW_NS) -> None:
        self._window_ns = window_ns
        # (arrival, arrival - stamp): the smallest first, then the smallest of those that came after it
        self._least: deque[tuple[int, int]] = deque()
        self._recent: deque[tuple[int, int]] = deque()  # the same of the last seconds,
        self._awaited_since_ns: int | None = None  # ... since when images have been waited for
        self._rises = 0  # of the least delay, since it fell
        self._queued = 0  # images in a row that were there already
        self._newest: tuple[int, int] | None = None  # stamp and offset

    def observe(self, stamp_ns: int, arrival_ns: int, awaited: bool = True) -> None:
        """An image stamped by the sender has arrived; or was taken up, where it was there already."""
        offset = arrival_ns - stamp_ns
        if self._newest is not None:
            stamp, before = self._newest
            if stamp_ns < stamp - _BACK_NS or abs(offset - before) > _JUMP_NS:
                self._least.clear()
                self._forget_recent()
        self._newest = stamp_ns, offset
        if self._least and offset < self._least[0][1] - _RISE_NS // 2:
            self._rises = 0
        _push(self._least, arrival_ns, offset, self._window_ns)
        self._queued = 0 if awaited else self._queued + 1
        if awaited:
            self._watch(arrival_ns, offset)
        elif self._queued >= _QUEUED:  # we are behind: arrivals tell when we came to them, not when they came
            self._forget_recent()

    @property
    def is_slow(self) -> bool:
        """Whether the sender's stamps run slower than time."""
        return self._rises >= _RISES

    def _watch(self, arrival_ns: int, offset: int) -> None:
        if self._awaited_since_ns is None:
            self._awaited_since_ns = arrival_ns
        _push(self._recent, arrival_ns, offset, _RECENT_NS)
        long_enough = arrival_ns - self._awaited_since_ns >= _RECENT_NS
        if long_enough and self._recent[0][1] > self._least[0][1] + _RISE_NS:
            self._least = self._recent.copy()
            self._rises += 1

    def _forget_recent(self) -> None:
        self._recent.clear()
        self._awaited_since_ns, self._rises = None, 0

    def host_ns(self, stamp_ns: int) -> int:
        """Host's time of a stamp near those observed; ValueError before the first."""
        if not self._least:
            raise ValueError("nothing has been observed yet")
        return stamp_ns + self._least[0][1]


def _push(least: deque[tuple[int, int]], arrival_ns: int, offset: int, window_ns: int) -> None:
    """The smallest of a window first, then the smallest of those that came after it."""
    while least and least[-1][1] >= offset:
        least.pop()
    least.append((arrival_ns, offset))
    while least[0][0] < arrival_ns - window_ns:
        least.popleft()
