"""A run that was cut off (a supervisor killed, a power cut): the next run of the camera goes on in its map.

While a run goes on, a *mark* lies beside its journal and says when it was last alive; it is taken away when
the run ends as it should. Who finds one at the start knows that the last run did not, and how long ago. Only
for live cameras in real time: a recording that is played again begins where its map began too.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from dataclasses import dataclass
from pathlib import Path

from prism_edge.bus.session import Bus
from prism_edge.config import Config
from prism_edge.workers.state_directory import kept_journal

log = logging.getLogger("prism_edge.supervisor")

MARK = "unfinished"
TOLD = "goes-on"  # in a run's folder: its processes are to go on in what the journal holds
OWN_JOURNAL = "own-journal"  # in a run's folder: its journal lies there too, as the kept one is not the run's
JOURNAL = ("tail", "base")  # backend/journal.py's files: named here, as the supervisor needs no numpy
STAMP_S = 10.0
MARK_BYTES = 120  # always as many: written over in place, which a full disk allows too


@dataclass(frozen=True)
class Moment:
    """Now, on the clock that runs from the computer's start and on the wall's."""

    boot: str  # which start of the computer
    boot_s: float
    wall_s: float

    @classmethod
    def now(cls) -> Moment:
        """At this moment."""
        boot = ""
        with contextlib.suppress(OSError):
            boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        clock = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
        return cls(boot, time.clock_gettime(clock), time.time())

    def since(self, earlier: Moment) -> float:
        """Seconds; negative where that can't be told (the wall clock was set back over a restart)."""
        if self.boot and self.boot == earlier.boot:  # nobody sets this clock
            return self.boot_s - earlier.boot_s
        return self.wall_s - earlier.wall_s


class RunMark:
    """The mark of this run in the journal's folder. Files that can't be written cost the recovery alone."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._path = folder / MARK
        self._found: Moment | None = None  # when the run was last alive that this one goes on from
        self._stamped_s = float("-inf")

    def begin(self, recover_s: float, now: Moment | None = None) -> bool:
        """Mark this run; whether it is to go on where an earlier one was cut off at most so long ago.

        Where it is not, the journal goes before the mark is there: cut off itself before its backend has
        begun, this run would hand on a map that had ended long ago.
        """
        now = now or Moment.now()
        last = self._read()
        self._found = last if last is not None and _recent(now.since(last), recover_s) else None
        if self._found is None:
            for name in JOURNAL:
                with contextlib.suppress(OSError):
                    (self.folder / name).unlink(missing_ok=True)
        self._stamp(now)
        return self._found is not None

    def alive(self) -> None:
        """Say so, now and then."""
        now = time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))
        if now - self._stamped_s >= STAMP_S:
            self._stamp(Moment.now())

    def end(self) -> None:
        """The run has ended as it should."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)

    def gave_up(self) -> None:
        """A process kept dying. In a map taken up that may be the map: the next run begins anew."""
        if self._found is not None:
            self.end()

    def refused(self) -> None:
        """The run could not start: the next may still go on where this one was to, and in nothing else."""
        if self._found is None:
            self.end()
        else:
            self._stamp(self._found)

    def _stamp(self, now: Moment) -> None:
        self._stamped_s = now.boot_s
        # Exactly: rounded up, it would be a moment that is yet to come for a run that begins at once.
        text = f"{now.boot or '-'} {now.boot_s!r} {now.wall_s!r}"
        with contextlib.suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
            descriptor = os.open(self._path, flags, 0o600)
            try:
                os.write(descriptor, text.ljust(MARK_BYTES - 1).encode("ascii") + b"\n")
            finally:
                os.close(descriptor)

    def _read(self) -> Moment | None:
        """When the run that left a mark was last alive; None for no mark, or noise."""
        try:
            descriptor = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
            with open(descriptor, "rb") as file:
                boot, boot_s, wall_s = file.read(MARK_BYTES).decode("ascii").split()
            return Moment("" if boot == "-" else boot, float(boot_s), float(wall_s))
        except (OSError, ValueError):
            return None


def _recent(ago_s: float, recover_s: float) -> bool:
    if not 0.0 <= ago_s <= recover_s:
        when = f"{ago_s:.0f} s ago" if ago_s >= 0.0 else "at a time that is yet to come"
        log.info("a run was cut off %s: a new map begins (state.recover_s is %g)", when, recover_s)
        return False
    log.info("the last run was cut off at most %.0f s ago: going on in its map", ago_s)
    return True


def run_mark(config: Config) -> RunMark | None:
    """The mark of a run with this configuration; None where no other is to go on in its map."""
    from prism_edge.sources.live.open import is_live

    folder = kept_journal(config.state)
    lasting = folder is not None and config.state.recover_s > 0.0
    if folder is None or not lasting or config.is_lockstep or not is_live(config.source.uri):
        return None
    return RunMark(folder)


def goes_on(bus: Bus) -> bool:
    """Whether this process belongs to a run that is to go on where an earlier one was cut off."""
    return bus.run_directory is not None and (bus.run_directory / TOLD).is_file()
