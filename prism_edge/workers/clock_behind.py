"""Whether a backend that was started by hand numbers what it says before what its predecessor said."""

from __future__ import annotations

import logging

from prism_edge.bus.pulse import Pulse

log = logging.getLogger("prism_edge.tracker")

OVERTAKEN = 1000  # one life numbers its corrections by ones, and an inbox holds a few hundred
SURE = 3  # in a row: a few may have been on their way when a backend ended
SAID = "the backend's corrections are passed over: its computer's clock is behind what they were numbered by"


class ClockBehind:
    """Such corrections can't be told from overtaken ones, so all that can be done is to say it."""

    def __init__(self, pulse: Pulse) -> None:
        self._pulse, self._in_a_row = pulse, 0

    def saw(self, ahead: int) -> None:
        """A correction has come whose number is so far ahead of the latest."""
        if ahead > -OVERTAKEN:
            self._in_a_row = 0
            self._pulse.warn("clock", "")
            return
        self._in_a_row += 1
        if self._in_a_row >= SURE:
            self._pulse.warn("clock", SAID)
        if self._in_a_row == SURE:
            log.error("%s", SAID)
