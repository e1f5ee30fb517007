"""One worker as an operating-system process: start, look, stop, with everything it started itself."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from typing import NoReturn

KILLED_S = 0.5  # what a killed process gets to be gone


class Child:
    """A started worker, leader of a process group of its own.

    A terminal's Ctrl-C thus reaches only the supervisor, and the whole group can be killed. Not of a session:
    Linux shares processors out among sessions first, and workers' niceness would count for nothing (autogroup
    in sched(7)). Start it from a thread that lives as long as the run: the kernel kills the worker when the
    thread that started it ends.
    """

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.exit_code: int | None = None  # negative: the signal that ended it

    @classmethod
    def spawn(cls, command: list[str]) -> Child:
        """Start a command line. Raises OSError where there is no such program."""
        no_input = (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0)
        pid = os.posix_spawn(command[0], command, os.environ, file_actions=[no_input], setpgroup=0)
        return cls(pid)

    @classmethod
    def fork(cls, body: Callable[[], int]) -> Child:
        """Start a copy of this process that calls ``body``, and ends with the exit code which that returns.

        What is loaded here is loaded there, in the same memory. Of several threads only the caller's goes on
        in the copy, so call it while there is but one.
        """
        _flush()  # or what waits to be written is written by both
        gc.freeze()  # the collector would write to what could stay shared
        # A signal may reach the copy while it still has our handlers, and would be taken for one to us.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        pid = os.fork()
        if pid == 0:
            _be_a_copy(body, before)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        with contextlib.suppress(ProcessLookupError, PermissionError):  # the copy does it too; who is first
            os.setpgid(pid, pid)
        return cls(pid)

    def poll(self) -> int | None:
        """Exit code, None while it runs; clears away what an ended worker had started."""
        if self.exit_code is None:
            # Looked at before it is collected: until then nobody else can get this process id.
            if os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
                return None
            self._kill_group()
            self.exit_code = self._collect()
        return self.exit_code

    def terminate(self) -> None:
        """Ask it to end."""
        if self.exit_code is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        """End it and all that it started, now.

        One that a driver holds in the kernel ends when that lets go: nobody waits for it for long, and
        :meth:`poll` says when it has ended.
        """
        if self.exit_code is None:
            self._kill_group()
            deadline = time.monotonic() + KILLED_S
            while self.poll() is None and time.monotonic() < deadline:
                time.sleep(0.005)

    def _collect(self) -> int:
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])

    def _kill_group(self) -> None:
        # Permission: macOS answers so for a group whose leader has ended.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)


def _be_a_copy(body: Callable[[], int], mask: set[int | signal.Signals]) -> NoReturn:
    """All that a fork does: nothing of it may end or clear up what is our process's."""
    code = 1
    try:
        os.setpgid(0, 0)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        signal.set_wakeup_fd(-1)
        # SIGINT too: a KeyboardInterrupt waits for the interpreter, which may just be about to sleep.
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        code = body()
    except BaseException:
        traceback.print_exc()
    finally:
        _flush()
        os._exit(code)


def _flush() -> None:
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()


def describe_exit(code: int) -> str:
    """An exit code in words."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"
