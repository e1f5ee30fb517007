"""Which pictures of a stream build on a damaged one (pure)."""

from __future__ import annotations

WAITING = "waits for a key frame: set the camera to send one each second"
_PATIENCE_NS = 10_000_000_000  # cameras send a key frame every few seconds, or none (intra refresh)


class Damage:
    """From a damaged picture on all are unsound until a key frame, which builds on none before it.

    The decoder marks only the picture that was hit. Where no key frame comes for ten seconds the stream has
    none, and mends itself piece by piece: from there on only the damaged pictures themselves count.
    """

    def __init__(self) -> None:
        self._first_hit_ns: int | None = None  # since the last key frame

    def hit(self, arrival_ns: int) -> None:
        """A picture came damaged, or could not be decoded at all."""
        if self._first_hit_ns is None:
            self._first_hit_ns = arrival_ns

    def spoils(self, is_key: bool, arrival_ns: int) -> bool:
        """Whether a picture that came whole builds on a damaged one."""
        if is_key:
            self._first_hit_ns = None
        return self._first_hit_ns is not None and arrival_ns - self._first_hit_ns <= _PATIENCE_NS
