"""Signals become events; and a worker does not outlive the supervisor that started it."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from types import FrameType

STOPPING = (signal.SIGTERM, signal.SIGINT)
AGAIN_S = 0.5  # so soon after the first it is the same wish: timeout(1) tells a process, and then its group
_PR_SET_PDEATHSIG = 1


class StopSignals:
    """Sets its events at the first SIGTERM or SIGINT; another, AGAIN_S later, ends the process on the spot.

    A thread of its own does it: a Python signal handler would wait for the main thread to come back from
    native code, and may not touch an event's lock, which the main thread may be holding.
    """

    def __init__(self, reload: bool = False) -> None:
        """Take the signals over; call from the main thread. None is lost until :meth:`listen`.

        With ``reload``, SIGHUP too: it sets ``reload_wanted``, but not under a terminal, whose going away it
        says: that ends the run.
        """
        self.stopped = threading.Event()
        self.reload_wanted = threading.Event()
        self._hangup = (signal.SIGHUP,) if reload and not _has_terminal() else ()
        self._also: list[threading.Event] = []
        self._read, write = os.pipe()
        os.set_blocking(write, False)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        for number in (*STOPPING, *self._hangup):
            signal.signal(number, _ignore)

    def listen(self) -> None:
        """From now on, and for what has come already, set the events."""
        threading.Thread(target=self._wait, name="signals", daemon=True).start()

    def also(self, event: threading.Event) -> None:
        """Set ``event`` as well, at once where the signal has come already."""
        self._also.append(event)
        if self.stopped.is_set():
            event.set()

    def _wait(self) -> None:
        first_s = 0.0
        while data := os.read(self._read, 64):
            for number in data:
                if number in self._hangup:
                    self.reload_wanted.set()
                if number not in STOPPING:
                    continue
                if self.stopped.is_set():
                    if time.monotonic() - first_s >= AGAIN_S:
                        os._exit(128 + number)
                    continue
                first_s = time.monotonic()
                self.stopped.set()
                for event in self._also:
                    event.set()


def _has_terminal() -> bool:
    """Whether this process has a controlling terminal."""
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
    except OSError:
        return False
    return True


def _ignore(number: int, frame: FrameType | None) -> None:
    """The wake-up pipe has told the thread already."""


def die_with(parent: int) -> None:
    """Have the kernel kill this process when ``parent`` dies; ends at once where it is dead already.

    SIGKILL, as a worker stuck in native code would not notice anything milder. Linux only.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it died before the line above took effect
        os._exit(128 + signal.SIGKILL)
