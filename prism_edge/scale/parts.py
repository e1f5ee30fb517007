"""What is known of the scale of each part of a map: they have units of their own (tracking/submaps.py).

A part is seeded by its first depth, turned to map units with the log scale that the tracker had then.
Whatever that image errs by is the part's own error, not that of the part that was left, which waits as it
was. Joined to an older part it has that one's unit: its keyframes bear the older one's number from then on,
and what was learned in both counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from prism_edge.config import ScaleConfig
from prism_edge.messages import HOME, Keyframe
from prism_edge.scale.filter import ScaleFilter
from prism_edge.scale.spread import LocalScale
from prism_edge.scale.steady import SteadyScale

MAP_HOLD_SIGMAS = 0.6  # the map's unit should stand still, too
MOST = 64  # parts besides home: a camera before what can't be tracked begins one every few seconds


class PartScale:
    """One part's."""

    def __init__(self, config: ScaleConfig, kalman: bool, log_scale: float = 0.0) -> None:
        """``log_scale`` is what its first depth is turned to its unit with."""
        self.filter = ScaleFilter(config, kalman, log_scale)
        self.steady = SteadyScale(config.hold_sigmas if kalman else 0.0, log_scale)
        self.of_map = SteadyScale(MAP_HOLD_SIGMAS if kalman else 0.0, log_scale)
        self.local, self.local_ns = LocalScale(), 0  # the stamp of its newest observation
        self.seen = 0.0  # independent observations of the map, all parts', when this one's last came
        self.joined = False  # to an older one, which has learned what this one had


class PartScales:
    """All that are known of one map; ``here`` is that of the part which the last keyframe belongs to."""

    def __init__(self, config: ScaleConfig, kalman: bool) -> None:
        self._kalman = kalman
        self._part, self._parts = HOME, {HOME: PartScale(config, kalman)}

    def __iter__(self) -> Iterator[PartScale]:
        return iter(self._parts.values())

    @property
    def apart(self) -> Iterator[PartScale]:
        """Those that count for themselves; what has been joined stays for depth that comes late."""
        return (part for part in self if not part.joined)

    @property
    def here(self) -> PartScale:
        """Of the part that was entered last."""
        return self._parts[self._part]

    def is_here(self, keyframe: Keyframe) -> bool:
        """Whether a keyframe belongs to the part that was entered last."""
        return keyframe.part == self._part

    def take_over(self, log_scale: float, sigma: float, lost_sigma: float = 0.0) -> None:
        """What was known of the map's unit before, which is its first part's."""
        home = self._parts[HOME]
        home.filter.take_over(log_scale, sigma, lost_sigma)
        home.steady.log_scale = home.of_map.log_scale = log_scale

    def join(self, newer: int, older: int, log_unit: float, sigma: float, config: ScaleConfig) -> None:
        """A part is in an older one's unit from now on: the log of its own in that one's, and its sigma."""
        if newer not in self._parts:
            return
        came = self._parts[newer]
        if older not in self._parts:  # it had no depth, or was forgotten
            self._parts[older] = PartScale(config, self._kalman, came.steady.log_scale - log_unit)
        known = self._parts[older]
        known.filter = known.filter.joined(came.filter, log_unit, sigma)
        came.joined = True

    def enter(self, keyframe: Keyframe, config: ScaleConfig) -> bool:
        """A keyframe is next; whether it belongs to another part than the one before."""
        if self.is_here(keyframe):
            return False
        left, begun_at = self.here, keyframe.log_scale
        if not math.isfinite(begun_at):  # an earlier build's: what was published last, maybe of another part
            begun_at = left.steady.log_scale
        if left.filter.is_open:  # nothing is known of it: it had no depth
            del self._parts[self._part]
        self._part = keyframe.part
        if self._part in self._parts:
            self.here.filter.resume(keyframe.travelled)
        else:
            self._parts[self._part] = PartScale(config, self._kalman, begun_at)
            besides = [part for part in self._parts if part != HOME]
            if len(besides) > MOST:
                del self._parts[besides[0]]  # the oldest, which is likely to have gone from the map
        return True
