"""How long a map waits for its first keyframe: for its depth, and then for a frame tracked beside it."""

from __future__ import annotations

import logging

from prism_edge.tracking.first_map import CAN_WAIT_MATCHES, SecondView, begin_structure
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap

log = logging.getLogger("prism_edge.tracking")

DEPTH_PATIENCE_S = 10.0  # no answer at all for this long: the network never got the picture
SLOWER = 2.0  # times as long as an answer took that came too late the next one is waited for
MOST_PATIENCE_S = 300.0  # the depth worker gives its network two minutes
GIVEN_UP = 64  # keyframes remembered that gave way without an answer
TRACKING_PATIENCE_S = 1.0  # from when the depth came, however slow the network is
LOOK_AGAIN_NS = 100_000_000  # after a second view from too near: the look at it takes longer than tracking
RETRY_S = 0.2  # after depth that is of no use; twice as long each time, for the network may be broken
NONE = -1


class FirstKeyframe:
    """The keyframe that a map begins with, and what has become of it. Stamps are the stream's."""

    def __init__(self) -> None:
        self._id, self._began_ns, self._now_ns = NONE, 0, 0
        self._depth_ns: int | None = None  # when its depth was taken in
        self._useless = False
        self._retry_s = RETRY_S
        self._too_near_ns: int | None = None
        self._patience_s = DEPTH_PATIENCE_S
        self._given_up: dict[int, int] = {}  # when each was made that gave way without an answer
        self._said = set[str]()  # why others gave way, each said once where no map begins for long

    def begin(self, keyframe: int, stamp_ns: int) -> None:
        """It has been made."""
        self._id, self._began_ns, self._now_ns = keyframe, stamp_ns, stamp_ns
        self._depth_ns, self._useless, self._too_near_ns = None, False, None

    def second_view(
        self, world: LocalMap, first: LocalKeyframe, frame: TrackedFrame, seed: int, stamp_ns: int
    ) -> SecondView:
        """What a frame says of the first map (:func:`begin_structure`); not asked each time it can wait."""
        self._said.clear()
        asked_ns = self._too_near_ns
        waits = asked_ns is not None and 0 <= stamp_ns - asked_ns < LOOK_AGAIN_NS
        if waits and frame.matched >= CAN_WAIT_MATCHES:
            return SecondView.TOO_NEAR
        said = begin_structure(world, first, frame, seed)
        self._too_near_ns = stamp_ns if said is SecondView.TOO_NEAR else None
        return said

    def has_depth(self) -> None:
        """Points have been seeded from its depth."""
        self._depth_ns, self._useless, self._retry_s = self._now_ns, False, RETRY_S

    def has_no_depth(self, keyframe: int) -> None:
        """Its depth, if it is this keyframe's, is of no use: another image may be better."""
        self._useless |= keyframe == self._id and self._depth_ns is None

    def heard(self, keyframe: int) -> None:
        """An answer for any keyframe has come. For one that gave way it says how slow the network is."""
        began_ns = self._given_up.pop(keyframe, None)
        if began_ns is not None:
            slow_s = SLOWER * (self._now_ns - began_ns) * 1e-9
            self._patience_s = min(max(self._patience_s, slow_s), MOST_PATIENCE_S)

    @property
    def awaits_answer(self) -> bool:
        """Whether the network may yet say what its depth is; a probe would take its picture's place."""
        return self._depth_ns is None and not self._useless

    def gives_way(self, stamp_ns: int) -> bool:
        """A frame was not tracked beside it: whether another keyframe is to take its place."""
        self._now_ns = stamp_ns
        if self._depth_ns is not None:
            why, since_ns, patience_s = "could not be tracked", self._depth_ns, TRACKING_PATIENCE_S
        elif self._useless:
            why, since_ns, patience_s = "has depth of no use", self._began_ns, self._retry_s
        else:
            why, since_ns, patience_s = "has had no depth", self._began_ns, self._patience_s
        if (stamp_ns - since_ns) * 1e-9 <= patience_s:
            return False
        if self._useless:
            self._retry_s = min(2.0 * self._retry_s, DEPTH_PATIENCE_S)
        elif self._depth_ns is None:
            self._given_up[self._id] = self._began_ns
            if len(self._given_up) > GIVEN_UP:
                del self._given_up[next(iter(self._given_up))]
        if why not in self._said:
            log.info("the first keyframe %s: it gives way", why)
        self._said.add(why)
        return True
