"""The journal in the state directory: of one run at a time, and of live cameras' alone."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
from pathlib import Path

from prism_edge.config import Config
from prism_edge.supervisor.run_directory import RunDirectory
from prism_edge.workers.cut_off import OWN_JOURNAL, TOLD, RunMark, run_mark

log = logging.getLogger("prism_edge.supervisor")

LOCK = "lock"
_ANOTHERS = "another run has it"


class KeptJournal:
    """Claimed by a run that may go on in the last one's map, or leave its own to the next.

    Any other keeps its journal in its own folder: a recording that is played or evaluated, and a run that
    finds this one taken. It neither reads nor writes what lies here, nor the mark.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self._mark: RunMark | None = None  # while it is claimed
        self._directory: RunDirectory | None = None
        self._lock = -1

    def claim(self, directory: RunDirectory) -> None:
        """Take it until :meth:`release` or this process's end, and tell the run's processes by its folder."""
        mark = run_mark(self._config)
        if mark is not None and (why := self._take(mark.folder)):
            log.warning(
                "the journal in %s is not this run's (%s): it keeps its own, and leaves the next run no map",
                mark.folder,
                why,
            )
            mark = None
        self._mark, self._directory = mark, directory
        if mark is None:
            self._tell_own()
        elif mark.begin(self._config.state.recover_s):
            directory.write(TOLD, "")

    def alive(self) -> None:
        """The run goes on; say so, now and then.

        Who clears a folder of what is old takes the lock first, which nobody writes to: it is made anew.
        """
        if self._mark is None:
            return
        if not self._locked(self._mark.folder) and self._take(self._mark.folder) == _ANOTHERS:
            words = "the journal in %s was cleared away, and another run has it now: it is no more this run's"
            log.warning(words, self._mark.folder)
            self._mark = None
            with contextlib.suppress(OSError):  # a full disk must not end the run
                self._tell_own()
        else:
            self._mark.alive()

    def ended(self) -> None:
        """The run has ended as it should: no other goes on in its map."""
        if self._mark is not None:
            self._mark.end()

    def gave_up(self) -> None:
        """A process kept dying."""
        if self._mark is not None:
            self._mark.gave_up()

    def refused(self) -> None:
        """The run could not start."""
        if self._mark is not None:
            self._mark.refused()

    def release(self) -> None:
        """Another run may take it. No process of this one writes it any more."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def _tell_own(self) -> None:
        """Processes that start from now on keep the journal in the run's own folder."""
        if self._directory is not None:
            self._directory.write(OWN_JOURNAL, "")

    def _locked(self, folder: Path) -> bool:
        """Whether the file that we hold is still the one that others would ask for."""
        try:
            theirs = os.stat(folder / LOCK, follow_symlinks=False)
            return self._lock >= 0 and os.path.samestat(os.fstat(self._lock), theirs)
        except OSError:
            return False

    def _take(self, folder: Path) -> str:
        """Why it can't be had; empty where it is ours."""
        self.release()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
            self._lock = os.open(folder / LOCK, flags, 0o600)
            # Not flock: workers are forks of ours, and one that outlives us would hold it on.
            fcntl.lockf(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            why = _ANOTHERS if self._lock >= 0 else "no permission"
        except OSError as error:
            why = error.strerror or str(error)
        else:
            return ""
        self.release()
        return why
