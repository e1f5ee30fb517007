"""Whether the tracker keeps up with its camera; `health` says where it doesn't."""

from __future__ import annotations

import logging

from prism_edge.bus.pulse import Pulse
from prism_edge.geometry.cameras import Camera

log = logging.getLogger("prism_edge.tracker")

PERIOD_NS = 10_000_000_000
MOST_DROPPED = 0.1  # of a period's images: a burst of other work is no lack of speed
FEWEST = 20  # images that a share is worth saying of


class KeepingUp:
    """Counts images period by period, by their stamps."""

    def __init__(self, pulse: Pulse) -> None:
        self._pulse, self._begun_ns = pulse, 0
        self._taken = self._dropped = 0
        self._logged = False

    def saw(self, stamp_ns: int, dropped: int, camera: Camera) -> None:
        """An image of ``camera`` has come, before which so many were ``dropped``: nobody looked at them."""
        if not 0 <= stamp_ns - self._begun_ns < 2 * PERIOD_NS:  # the first, or after a pause
            self._begun_ns, self._taken, self._dropped = stamp_ns, 0, 0
            self._pulse.warn("speed", "")
            return
        self._taken, self._dropped = self._taken + 1, self._dropped + dropped
        if stamp_ns - self._begun_ns < PERIOD_NS:
            return
        images = self._taken + self._dropped
        share = self._dropped / images
        self._begun_ns, self._taken, self._dropped = stamp_ns, 0, 0
        if images < FEWEST or share < MOST_DROPPED:
            self._pulse.warn("speed", "")
            return
        too_much = f"{camera.width}x{camera.height} at their rate is more than this computer does"
        said = f"{100 * share:.0f} % of the images were dropped: {too_much}"
        self._pulse.warn("speed", said)
        if not self._logged:
            self._logged = True
            log.warning("%s (docs/TROUBLESHOOTING.md); from now on `health` says so", said)
