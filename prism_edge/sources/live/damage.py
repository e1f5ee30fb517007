"""Which pictures of a stream build on a damaged one (pure)."""

from __future__ import annotations

_HEALED_NS = 10_000_000_000  # intra refresh, which has no key frames, renews the whole picture sooner


class Damage:
    """From a damaged picture on all are unsound until a key frame, which builds on none before it.

    The decoder marks only the picture that was hit. A stream without key frames (intra refresh) mends itself
    piece by piece: ten seconds after its last damage it is believed again.
    """

    def __init__(self) -> None:
        self._hit_ns: int | None = None

    def hit(self, arrival_ns: int) -> None:
        """A picture came damaged, or could not be decoded at all."""
        self._hit_ns = arrival_ns

    def spoils(self, is_key: bool, arrival_ns: int) -> bool:
        """Whether a picture that came whole builds on a damaged one."""
        if is_key or (self._hit_ns is not None and arrival_ns - self._hit_ns > _HEALED_NS):
            self._hit_ns = None
        return self._hit_ns is not None
