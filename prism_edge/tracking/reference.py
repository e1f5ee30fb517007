"""The keyframe that the camera is at, beside which the next is weighed: the newest, or one it is back at."""

from __future__ import annotations

from prism_edge.tracking.local_map import LocalKeyframe, LocalMap
from prism_edge.tracking.submaps import Parts

NONE = -1


class Reference:
    """Which keyframe it is, since when, and what was seen from it at first."""

    def __init__(self) -> None:
        self.since_ns = 0
        self.matches = 0  # of the frame that matched most since then
        self.depth = 1.0  # median, in map units
        self._back_at = NONE  # the older keyframe that the camera has come back to

    def keyframe(self, world: LocalMap, parts: Parts) -> LocalKeyframe:
        """The keyframe; the newest where the older one has been culled."""
        return world.keyframes.get(self._back_at) or parts.newest(world)

    def leave(self) -> None:
        """It is the newest again."""
        self._back_at = NONE

    def renew(self, stamp_ns: int) -> None:
        """A new keyframe has been made where the camera is."""
        self._back_at, self.since_ns, self.matches = NONE, stamp_ns, 0

    def move_to(self, keyframe: LocalKeyframe, world: LocalMap, parts: Parts, stamp_ns: int) -> None:
        """The camera is at this one now."""
        self._back_at = NONE if keyframe is parts.newest(world) else keyframe.id
        self.since_ns, self.matches = stamp_ns, 0
        self.depth = world.median_depth(keyframe)
