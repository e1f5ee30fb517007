"""One worker as an operating-system process: start, look, stop, with everything it started itself."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from prism_edge.processes import Process

Command = Callable[[Process, Path, int], list[str]]  # the last: how often it was started before


def worker_command(process: Process, config_file: Path, life: int) -> list[str]:
    """The command line of a worker that dies with this process; ``life``: how often it was started before."""
    command = [sys.executable, "-m", "prism_edge.workers", process.name]
    return [*command, "--config", str(config_file), "--parent", str(os.getpid()), "--life", str(life)]


class Child:
    """A started worker, leader of a process group of its own.

    A terminal's Ctrl-C thus reaches only the supervisor, and the whole group can be killed. Not of a session:
    Linux shares processors out among sessions first, and workers' niceness would count for nothing (autogroup
    in sched(7)). Start it from a thread that lives as long as the run: the kernel kills the worker when the
    thread that started it ends.
    """

    def __init__(self, command: list[str]) -> None:
        self._popen = subprocess.Popen(command, stdin=subprocess.DEVNULL, process_group=0)
        self.pid = self._popen.pid
        self.exit_code: int | None = None  # negative: the signal that ended it

    def poll(self) -> int | None:
        """Exit code, None while it runs; clears away what an ended worker had started."""
        if self.exit_code is None:
            # Looked at before it is collected: until then nobody else can get this process id.
            if os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
                return None
            self._kill_group()
            self.exit_code = self._popen.wait()
        return self.exit_code

    def terminate(self) -> None:
        """Ask it to end."""
        if self.exit_code is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        """End it and all that it started, now."""
        if self.exit_code is None:
            self._kill_group()
            self.exit_code = self._popen.wait()

    def _kill_group(self) -> None:
        # Permission: macOS answers so for a group whose leader has ended.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)


def describe_exit(code: int) -> str:
    """An exit code in words."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"
