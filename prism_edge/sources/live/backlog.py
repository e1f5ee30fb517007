"""Which packets of a stream to leave out while decoding can't keep up (pure)."""

from __future__ import annotations

_LATE_NS = 1_000_000_000
_CAUGHT_UP_NS = 300_000_000
AT_ONCE_NS = 10_000_000  # a packet that was there already takes no longer, on a busy machine either
_QUEUED, _AWAITED = 5, 50  # packets in a row: that wait for us, that we wait for


class Backlog:
    """Beyond a second of lateness only key frames are decoded, until one comes that is hardly late.

    Any other picture builds on those before it, so decoding can go on only with a key frame. Only packets
    that wait for us can be caught up with: where we wait for them, it is their stamps that are wrong.
    """

    def __init__(self) -> None:
        self._behind = False
        self._late_ns = self._queued = self._awaited = 0

    def leaves_out(self, late_ns: int, waited_ns: int, is_key: bool) -> bool:
        """Whether to pass over a packet that came ``late_ns`` after the least time it can take, and for which
        we waited ``waited_ns``."""
        at_once = waited_ns < AT_ONCE_NS
        self._late_ns = late_ns
        self._queued = self._queued + 1 if at_once else 0
        # Late ones alone: after a stall the first packet is awaited, as were all before it, and it is late.
        self._awaited = self._awaited + 1 if late_ns > _LATE_NS and not at_once else 0
        if self._behind and is_key and (late_ns < _CAUGHT_UP_NS or self.misled):
            self._behind = False
        elif late_ns > _LATE_NS and self._queued >= _QUEUED:
            self._behind = True
        return self._behind and not is_key

    @property
    def misled(self) -> bool:
        """Whether packets have long been late although none waits for us: their stamps run too slow."""
        return self._late_ns > _LATE_NS and self._awaited >= _AWAITED
