"""Which packets of a stream to leave out while decoding can't keep up (pure)."""

from __future__ import annotations

_LATE_NS = 1_000_000_000
_CAUGHT_UP_NS = 300_000_000


class Backlog:
    """Beyond a second of lateness only key frames are decoded, until one comes that is hardly late.

    Any other picture builds on those before it, so decoding can go on only with a key frame.
    """

    def __init__(self) -> None:
        self._behind = False

    def leaves_out(self, late_ns: int, is_key: bool) -> bool:
        """Whether to pass over a packet that came ``late_ns`` after the least time it can take."""
        if self._behind and is_key and late_ns < _CAUGHT_UP_NS:
            self._behind = False
        elif late_ns > _LATE_NS:
            self._behind = True
        return self._behind and not is_key
