"""The daemon as a child process of an evaluation: started, watched, and always ended."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

import psutil

from prism_edge.errors import EvaluationError, PrismError
from prism_edge.huge_pages import with_huge_pages
from prism_edge.workers.launch import own_module
from prism_edge.workers.stopping import die_with

SUPERVISOR = tuple(own_module("prism_edge.supervisor"))
_KILLED_S = 2.0  # for the kernel to clear away what was killed
_ERROR = ": error: "  # how a process of the daemon begins its one line


class DaemonError(PrismError):
    """The daemon ended before its time; the message is its own and so is the exit code."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class Daemon:
    """A running daemon; leaving the ``with`` block ends it and all it started.

    ``command`` is completed by ``--config FILE``; what it says goes to ``log``. Start it from the main
    thread: it dies with the thread that started it, even by SIGKILL.
    """

    def __init__(
        self, config_file: Path, log: Path, stop_s: float, command: Sequence[str] = SUPERVISOR
    ) -> None:
        self._log, self._stop_s = log, stop_s
        self.started_ns = time.monotonic_ns()
        try:
            with log.open("wb") as output:
                self._popen = subprocess.Popen(
                    [*command, "--config", str(config_file)],
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env=with_huge_pages(os.environ),
                    start_new_session=True,  # Ctrl-C is for the evaluation, which then ends the daemon
                    preexec_fn=partial(die_with, os.getpid()),
                )
        except OSError as error:
            raise EvaluationError(f"the daemon can't be started: {error}") from error

    @property
    def pid(self) -> int:
        """Process id of the supervisor."""
        return self._popen.pid

    def check(self) -> None:
        """Raises DaemonError, with the daemon's own words, if it has ended."""
        code = self._popen.poll()
        if code is not None:
            words = last_error(self._log) or f"the daemon ended by itself; {self._log} says more"
            raise DaemonError(words, code if 0 < code < 128 else EvaluationError.exit_code)

    def stop(self) -> None:
        """Ends it: SIGTERM, then, when its own patience is over, SIGKILL to whatever is left."""
        family = []
        with contextlib.suppress(psutil.Error):
            family = psutil.Process(self.pid).children(recursive=True)
        if self._popen.poll() is None:
            self._popen.send_signal(signal.SIGTERM)
            try:
                self._popen.wait(self._stop_s + 1.0)
            except subprocess.TimeoutExpired:
                self._popen.kill()
        for process in family:  # psutil knows a process id that was given to someone else
            with contextlib.suppress(psutil.Error):
                process.kill()
        psutil.wait_procs(family, timeout=_KILLED_S)
        self._popen.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


def last_error(log: Path) -> str:
    """The last error that a process of the daemon reported in one line, else its last line of all."""
    with contextlib.suppress(OSError):
        lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
        errors = [line for line in lines if line.startswith("prism-edge") and _ERROR in line]
        if errors:
            return errors[-1].partition(_ERROR)[2]
        if lines:
            return lines[-1]
    return ""
