"""When a map is asked for a rolling shutter that nobody has told of, and what becomes of what is found."""

from __future__ import annotations

import logging
import math

from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.mapper import Mapper
from prism_edge.backend.readout import Readout, readout_of, take_out
from prism_edge.bus.pulse import Pulse

log = logging.getLogger("prism_edge.backend")

SUBJECT = "rolling shutter"  # what all that is said of it begins with
_BUDGET_S = 20.0
# Keyframes at which it is looked for, each so many times the one before: where it can't be taken out or is
# well known, and else.
FIRST, GROWTH, SOON, LAST = 15, 2.0, 1.4, 400
MOST_AT_END = 3


class ShutterWatch:
    """Looks where a map has grown enough, and at its end, until a readout that is said is surely another."""

    def __init__(self, mapper: Mapper, pulse: Pulse, takes_out: bool) -> None:
        """``takes_out``: what is found where nobody says a readout; else that is only told."""
        self._mapper, self._pulse, self._takes_out = mapper, pulse, takes_out
        self._epoch = -1
        self._begin()

    def _begin(self) -> None:
        self._next, self._looked_at, self._at_end = FIRST, 0, 0

    def look(self, ended: bool = False) -> bool | None:
        """Between keyframes: whether the map is another by it; None where it was not looked for.

        It takes a second at most, and the pulse says so. ``ended``: no keyframe will come any more.
        """
        world, epoch = self._mapper.world, self._mapper.epoch
        if epoch != self._epoch:
            self._epoch = epoch
            self._begin()
            self._pulse.warn(SUBJECT, "")
        keyframes = len(world.keyframes)
        due = keyframes >= self._next or (ended and keyframes > self._looked_at)
        if not due or keyframes > LAST:
            return None
        self._pulse.working(SUBJECT, _BUDGET_S)
        found = readout_of(world)
        takes_out = self._takes_out and not world.readout_said and _of_one_camera(world)
        soon = takes_out and not (found is not None and found.is_well_known)
        self._next, self._looked_at = math.ceil((SOON if soon else GROWTH) * keyframes), keyframes
        if found is None:
            return False
        if not found.is_clear and not (world.readout_ms and found.is_news):
            log.info("%s: none for sure but what is known (%s)", SUBJECT, _told(found))
            return False
        if takes_out:
            take_out(world, found.ms)
            self._mapper.loops.overhaul()
            # At the end once more: what had bent the map may have hidden a part.
            self._at_end += ended
            self._looked_at = 0 if self._at_end < MOST_AT_END else keyframes
            log.info("%s: %s: taken out from now on", SUBJECT, _told(found))
            return True
        self._next = self._looked_at = LAST + 1  # for this map that is all
        said = f"{SUBJECT}: {_told(found)}: tell readout_ms (docs/CAMERAS.md#rolling-shutters)"
        log.warning("%s", said)
        self._pulse.warn(SUBJECT, said)
        return False


def _of_one_camera(world: GlobalMap) -> bool:
    return len({keyframe.camera for keyframe in world.keyframes.values()}) == 1


def _told(found: Readout) -> str:
    more = "longer" if found.ms > 0.0 else "shorter"
    said = f"rows are read over {abs(found.ms):.1f} ms {more} than is known"
    return f"{said}, sigma {found.sigma_ms:.1f}, {found.keyframes} keyframes"
