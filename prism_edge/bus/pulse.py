"""The heartbeat of one process: a thread that says what the others are doing."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable

from prism_edge.bus.warnings import Warnings
from prism_edge.errors import BusError
from prism_edge.messages import Heartbeat
from prism_edge.vital import vital

PERIOD_S = 0.5
# While links are still coming up, what was said may have reached nobody: it is said again soon.
FIRST_PERIOD_S, FIRST_S = 0.1, 1.0
STARTING_S = 60.0
# Work that may take longer is said at once: native code may let nobody speak until it is done, and who was
# idle when last heard may be silent for no longer than that (supervisor/liveness.py).
LONG_S = 5.0
CLOSING_S = 5.0  # for the thread to come back from what it says, on a busy machine too

log = logging.getLogger("prism_edge.bus")


class Pulse:
    """Publishes a :class:`Heartbeat` twice a second from its own thread.

    The worker stamps what it is doing (cheap: no message goes out, but for long work), so that the
    supervisor can tell a hang, an activity beyond its budget, from work and from idleness. ``values`` are
    shown on `health`; what :attr:`warn` is told becomes the process's message there, and its level a
    warning, while it stands.
    """

    def __init__(
        self, process: str, publish: Callable[[Heartbeat], None], announce: Callable[[], None]
    ) -> None:
        """``publish`` sends a heartbeat; ``announce`` tells the others, once, that this process is ready."""
        self.values: dict[str, str] = {}
        self.warn = Warnings(self.values)
        self._process, self._publish, self._announce = process, publish, announce
        self._doing: tuple[str, str, int, float] = ("starting", "", time.monotonic_ns(), STARTING_S)
        self._due, self._speaking = threading.Event(), threading.Lock()
        self._closing = False
        self._ready = False
        self._ready_s = float("inf")
        self._thread = vital(self._run, "pulse")
        self._thread.start()

    def ready(self) -> None:
        """Everything is loaded and subscribed to; the others may send. Said at once."""
        self._stamp("ready")
        if not self._ready:
            self._ready, self._ready_s = True, time.monotonic()
            self._announce()
        self._due.set()

    def working(self, activity: str, budget_s: float = LONG_S) -> None:
        """An activity begins that should take no longer than ``budget_s``."""
        self._stamp("working", activity, budget_s)
        if budget_s > LONG_S:
            self._say()

    def idle(self) -> None:
        """Nothing to do: waiting for messages."""
        self._stamp("idle")

    def ended(self) -> None:
        """The stream has ended and all that it caused is done. Said at once, and once until there is more."""
        if self._doing[0] != "ended":
            self._stamp("ended")
            self._due.set()

    def count(self, name: str) -> int:
        """Adds one to a counter among ``values`` and returns it."""
        total = int(self.values.get(name, "0")) + 1
        self.values[name] = str(total)
        return total

    def beat(self) -> Heartbeat:
        """The heartbeat of this moment."""
        state, activity, since, budget = self._doing
        values = {k: str(v) for k, v in dict(self.values).items()}
        return Heartbeat(
            self._process, os.getpid(), time.monotonic_ns(), state, activity, since, budget, values
        )

    def close(self) -> None:
        """Ends the thread."""
        self._closing = True
        self._due.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=CLOSING_S)

    def _is_new(self) -> bool:
        return self._ready and time.monotonic() < self._ready_s + FIRST_S

    def _stamp(self, state: str, activity: str = "", budget_s: float = 0.0) -> None:
        # Work before `ready`, such as loading a network, is still a part of starting.
        if not self._ready and state in ("working", "idle"):
            state, budget_s = "starting", budget_s or STARTING_S
        # One tuple, so that the thread never sees halves of two stamps.
        self._doing = (state, activity, time.monotonic_ns(), budget_s)

    def _run(self) -> None:
        while not self._closing:
            self._say()
            self._due.wait(FIRST_PERIOD_S if self._is_new() else PERIOD_S)
            self._due.clear()

    def _say(self) -> None:
        try:
            with self._speaking:  # the last to be heard is the last that is true
                self._publish(self.beat())
        except BusError as error:
            if not self._closing:
                log.warning("heartbeat not sent: %s", error)
