"""What the tracker makes of the world, in the two words of `status`."""

from __future__ import annotations

import time
from typing import Any

from prism_edge.bus import ros
from prism_edge.bus.session import Bus
from prism_edge.messages import BUILDING, DEGRADED, INITIALISING, LOCALISED, LOST, OK, RELOCALISING
from prism_edge.tracking.depth_watch import DepthWatch

_STATUS_NS = 500_000_000
_SAID_NS = 2_000_000_000
_LEVELS = {INITIALISING: ros.LEVEL_WARN, DEGRADED: ros.LEVEL_WARN, LOST: ros.LEVEL_ERROR}


class TrackerStatus:
    """Publishes `status` twice a second, also where no image comes, and whenever a word changes."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self.metres, self._epoch = DepthWatch(), -1
        self._shown: tuple[str, int, str] | None = None
        self._last: Any | None = None  # what was said,
        self._again_s = 0.0  # ... and when it is due again without an image
        self._happened, self._happened_to, self._happened_until_ns = "", -1, 0  # which map; told until when

    def repeat(self) -> None:
        """Say it once more where it is due, by the stamp that it had: no image came for a while."""
        if self._last is not None and time.monotonic() >= self._again_s:
            self._again_s = time.monotonic() + _STATUS_NS / 1e9
            self._bus.publish("status", self._last)

    def say(self, word: str, epoch: int, now_ns: int) -> None:
        """What has happened to the map of an epoch: said of that one for a while."""
        self._happened, self._happened_to, self._happened_until_ns = word, epoch, now_ns + _SAID_NS

    def show(
        self, epoch: int, odometry: str, at_home: bool, localise_only: bool, stamp_ns: int,
        values: dict[str, object],
    ) -> None:
        """``at_home``: its place in the map is known. Without metres it is degraded, well as it may track.

        Another ``epoch`` is another map, whose metres nobody has found fault with yet.
        """
        if epoch != self._epoch:
            self.metres, self._epoch = DepthWatch(), epoch
        if localise_only:
            self.metres.rest()
        trouble = self.metres.trouble(stamp_ns)
        odometry = DEGRADED if trouble and odometry == OK else odometry
        state = LOCALISED if localise_only else BUILDING
        if odometry == LOST or not at_home:
            state = RELOCALISING
        elif epoch == self._happened_to and stamp_ns < self._happened_until_ns:
            state = self._happened
        due = stamp_ns // _STATUS_NS
        if self._shown == (odometry, due, state):
            return
        self._shown = (odometry, due, state)
        shown = {"odometry": odometry, "map": state, **values, "depth": trouble or "ok"}
        row = ("tracking", _LEVELS.get(odometry, ros.LEVEL_OK), f"{odometry} {state}", shown)
        self._last = ros.diagnostics(stamp_ns, [row])
        self._again_s = time.monotonic() + 2 * _STATUS_NS / 1e9  # a slow camera's next image may still say it
        self._bus.publish("status", self._last)
        self._bus.pulse.values.update({name: str(value) for name, value in shown.items()})
