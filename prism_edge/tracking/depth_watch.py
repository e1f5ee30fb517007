"""Whether the metres still come: what makes a camera that tracks well say `degraded` all the same."""

from __future__ import annotations

import math

SILENT_NS = 5_000_000_000  # a keyframe without depth for this long; a slow network takes 2 s
REFUSED = 3  # more observations of the scale refused than accepted lately; one is an outlier like any other
MOST_REFUSED = 10  # that count
MUTE = 10  # keyframes in a row whose depth says nothing of the scale; a map's first few may not
MOST_WAITING = 64  # keyframes remembered, the newest and the oldest: that tells how long it has been


class DepthWatch:
    """Hears of keyframes, of their depths and scales. All times are of the stream."""

    def __init__(self) -> None:
        self._waiting: dict[int, int] = {}  # stamp of each keyframe without an answer
        self._unusable = ""
        self._refused, self._contradicted = 0, False
        self._deep: set[int] = set()  # keyframes with depth whose scale has not been said yet
        self._mute = 0

    def keyframe(self, number: int, stamp_ns: int) -> None:
        """A keyframe's picture has gone to the network."""
        if len(self._waiting) >= MOST_WAITING:
            self._waiting.popitem()
        self._waiting[number] = stamp_ns

    def is_waiting(self, keyframe: int) -> bool:
        """Whether a keyframe has no answer yet."""
        return keyframe in self._waiting

    def depth(self, keyframe: int, valid: bool, reason: str) -> None:
        """A keyframe's depth has come; those before it won't, since the newest picture wins."""
        self._waiting = {k: stamp for k, stamp in self._waiting.items() if k > keyframe}
        self._unusable = "" if valid else f"no usable depth: {reason}"
        if valid and len(self._deep) < MOST_WAITING:
            self._deep.add(keyframe)

    def scale(self, keyframe: int, observation: float, accepted: bool) -> None:
        """The scale after a keyframe; an observation that is not finite is none."""
        if math.isfinite(observation):
            self._mute = 0
        elif keyframe in self._deep:  # one without depth, as a slow network leaves them, says nothing
            self._mute += 1
        self._deep = {k for k in self._deep if k > keyframe}
        if math.isfinite(observation):
            self._refused = max(self._refused - 1, 0) if accepted else min(self._refused + 1, MOST_REFUSED)
            # Also where the filter has given in by now: as long again, since either may have been wrong.
            self._contradicted = self._refused > 0 and (self._contradicted or self._refused >= REFUSED)

    def rest(self) -> None:
        """No keyframes are made: whose depth is awaited says nothing of a map that stays as it is."""
        self._waiting, self._unusable, self._mute = {}, "", 0

    def trouble(self, now_ns: int) -> str:
        """What is wrong with the metres, in words; empty where nothing is."""
        if self._waiting and now_ns - min(self._waiting.values()) > SILENT_NS:
            return f"no depth for {(now_ns - min(self._waiting.values())) * 1e-9:.0f} s"
        if self._unusable:
            return self._unusable
        if self._mute >= MUTE:
            return f"too few points have depth that tells the scale, in {self._mute} keyframes"
        return "depth contradicts the scale" if self._contradicted else ""
