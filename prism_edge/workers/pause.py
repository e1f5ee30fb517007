"""The command `pause`: images are held back until they may go on."""

from __future__ import annotations

import time
from collections.abc import Callable

from prism_edge.bus.commands import Reply, on_or_off
from prism_edge.bus.session import Bus

_LOOK_S = 0.1  # a command is done within this


class Pause:
    """Whether the source is to hold its images back."""

    def __init__(self, bus: Bus, meanwhile: Callable[[], None] = lambda: None) -> None:
        """``meanwhile`` is called now and then in a long wait."""
        self.on = False
        self._stopped, self._meanwhile = bus.stopped, meanwhile
        self._desk = bus.commands({"pause": self._switch})

    @property
    def warning(self) -> str:
        """What `health` is to warn of."""
        return "paused by command" if self.on else ""

    def serve(self) -> None:
        """Do what has been asked."""
        self._desk.serve()

    def wait(self, seconds: float) -> None:
        """Wait, and do meanwhile what is asked; ends early when the process is to stop."""
        end = time.monotonic() + seconds
        self.serve()
        while not self._stopped.is_set() and (left := end - time.monotonic()) > 0:
            self._stopped.wait(min(left, _LOOK_S))
            self.serve()
            if left > _LOOK_S:
                self._meanwhile()

    def hold(self) -> int:
        """Returns once images may go on: after how many nanoseconds."""
        self.serve()
        start_ns = time.monotonic_ns()
        while self.on and not self._stopped.is_set():
            self.wait(_LOOK_S)
            self._meanwhile()
        return time.monotonic_ns() - start_ns

    def _switch(self, argument: str) -> Reply:
        wanted = on_or_off(argument)
        changed, self.on = wanted != self.on, wanted
        state = "images are held back" if wanted else "images go on"
        return Reply(True, state if changed else f"{state} already")
