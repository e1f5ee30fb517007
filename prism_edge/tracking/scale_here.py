"""The map's scale where the camera is: each part has a unit of its own, and so has the next map.

An error of the scale moves `odom` along the way that was gone in that unit: the way gone before, in another
unit, keeps the error that was known then. The errors are taken as one, as a network's bias is in all of them.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.messages import HOME, Scale
from prism_edge.tracking.drift import Drift
from prism_edge.tracking.odometry import MetricOdometry
from prism_edge.tracking.tracker import Tracker

Told: TypeAlias = tuple[float, float, float, float]  # log scale, the map's, sigma, local sigma

UNKNOWN_SCALE_SIGMA = 1.0
MOST = 64  # parts besides home and the present one: what can't be tracked begins one every few seconds


class ScaleHere:
    """Hands what the scale process says of a part to the tracker while the camera is in that part."""

    def __init__(self, tracker: Tracker, odometry: MetricOdometry, drift: Drift) -> None:
        self._tracker, self._odometry, self._drift = tracker, odometry, drift
        self.sigma = UNKNOWN_SCALE_SIGMA  # of the log scale
        self._epoch, self._part = tracker.epoch, HOME
        self._told: dict[int, Told] = {}  # the last of each part
        self._error, self._since = np.zeros(3), np.zeros(3)

    @property
    def odom_error(self) -> Array:
        """Standard deviation of `odom`'s position that scale makes, along its one direction (3), metres."""
        return np.asarray(self._error + self.sigma * (self._odometry.odom_from_camera[:3, 3] - self._since))

    def begin(self, sigma: float | None = None) -> None:
        """Another map, with another unit; ``sigma`` is of the scale that the tracker has of it, if any."""
        self._epoch, self._part = self._tracker.epoch, self._tracker.parts.current
        # Who comes home from a part has that of home again, though nothing was said of it since.
        known = self._tracker.log_scale, self._tracker.map_log_scale
        self._told = {} if sigma is None else {HOME: (*known, sigma, 0.0)}
        self._change_unit(UNKNOWN_SCALE_SIGMA if sigma is None else sigma)

    def hear(self, scale: Scale) -> None:
        """Something was said of this map; for a part that nothing was said of yet it holds as well."""
        self._told.pop(scale.part, None)
        self._told[scale.part] = scale.log_scale, scale.map_log_scale, scale.sigma, scale.local_sigma
        others = [part for part in self._told if part not in (HOME, self._part)]
        if len(others) > MOST:
            del self._told[others[0]]  # nothing was said of it for longest
        if scale.part == self._part or self._part not in self._told:
            self._apply(self._told[scale.part])
            self.sigma = scale.sigma
        if self._part not in self._told:
            self._tracker.map_log_scale = scale.log_scale  # a part begins in the unit that is published

    def enter(self) -> None:
        """The camera may be in another map or part than before, or its part be joined to another."""
        if self._tracker.epoch != self._epoch:
            self.begin()
        if self._tracker.parts.current == self._part:
            return
        self._part = self._tracker.parts.current
        told = self._told.get(self._part)
        self._change_unit(self.sigma if told is None else told[2])
        if told is None:
            self._tracker.map_log_scale = self._tracker.log_scale
        else:
            self._apply(told)

    def _apply(self, told: Told) -> None:
        self._tracker.log_scale, self._tracker.map_log_scale, _, self._drift.local_sigma = told

    def _change_unit(self, sigma: float) -> None:
        self._error, self._since = self.odom_error, self._odometry.odom_from_camera[:3, 3].copy()
        self.sigma = sigma
