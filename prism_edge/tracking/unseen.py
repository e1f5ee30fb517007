"""What of the camera's way nobody saw: from a map that it was lost in to the next, or to another part."""

from __future__ import annotations

from dataclasses import dataclass

from prism_edge.messages import LOST


@dataclass(frozen=True)
class Unseen:
    """What of the way from the last pose to this one nobody saw."""

    lost: bool = False  # on it the camera was lost: how fast it is now is not known
    unseen_s: float = 0.0  # for so long it was where no map that holds both ends has it


class Sight:
    """Follows one camera from pose to pose."""

    def __init__(self) -> None:
        self._map: tuple[int, int] | None = None  # epoch and part of the last pose
        self._stamp_ns = 0  # of it
        self._missed = self._lost = False  # a frame since had no pose; and was called lost

    def miss(self, odometry: str) -> None:
        """A frame has no pose."""
        self._missed, self._lost = True, self._lost or odometry == LOST

    def see(self, epoch: int, part: int, reference_ns: int, stamp_ns: int) -> Unseen:
        """A frame has a pose in a part of a map, beside a keyframe made at ``reference_ns``.

        A part that gets its place in the map, while it is tracked, is another from one frame to the next.
        """
        elsewhere = self._missed and self._map not in (None, (epoch, part))
        # From its first keyframe on a map that begins has the way; a stored one's are of another time.
        until_ns = reference_ns if self._stamp_ns < reference_ns <= stamp_ns else stamp_ns
        unseen_s = (until_ns - self._stamp_ns) * 1e-9 if elsewhere else 0.0
        unseen = Unseen(self._lost or elsewhere, unseen_s)
        self._map, self._stamp_ns = (epoch, part), stamp_ns
        self._missed = self._lost = False
        return unseen
