"""When a map is asked for a rolling shutter that nobody has told of, and how that is said."""

from __future__ import annotations

import logging

from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.readout import Readout, readout_of
from prism_edge.bus.pulse import Pulse

log = logging.getLogger("prism_edge.backend")

SUBJECT = "rolling shutter"  # what all that is said of it begins with
_BUDGET_S = 20.0
FIRST, GROWTH, LAST = 20, 2, 400  # keyframes at which it is looked for, each so many times the one before


class ShutterWatch:
    """Looks where a map has grown enough, and at its end, until it is sure."""

    def __init__(self, pulse: Pulse) -> None:
        self._pulse = pulse
        self._epoch, self._next, self._looked_at = -1, FIRST, 0

    def look(self, world: GlobalMap, epoch: int, ended: bool = False) -> bool:
        """Between keyframes: whether it was looked for, for a second at most, and the pulse says so.

        ``ended``: no keyframe will come any more.
        """
        if epoch != self._epoch:
            self._epoch, self._next, self._looked_at = epoch, FIRST, 0
            self._pulse.values.pop("warning", None)
        keyframes = len(world.keyframes)
        due = keyframes >= self._next or (ended and keyframes > self._looked_at)
        if not due or keyframes > LAST:
            return False
        self._pulse.working(SUBJECT, _BUDGET_S)
        self._next, self._looked_at = GROWTH * keyframes, keyframes
        found = readout_of(world)
        if found is None:
            return True
        if not found.is_clear:
            log.info("%s: none for sure but what is said (%s)", SUBJECT, _told(found))
            return True
        self._next = self._looked_at = LAST + 1  # for this map that is all
        said = f"{SUBJECT}: {_told(found)}: tell readout_ms (docs/CAMERAS.md#rolling-shutters)"
        log.warning("%s", said)
        self._pulse.values["warning"] = said
        return True


def _told(found: Readout) -> str:
    more = "longer" if found.ms > 0.0 else "shorter"
    said = f"rows are read over {abs(found.ms):.1f} ms {more} than is said"
    return f"{said}, sigma {found.sigma_ms:.1f}, {found.keyframes} keyframes"
