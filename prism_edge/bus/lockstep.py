"""Lockstep: nobody's frame is let out before everybody has done the last one (docs/ARCHITECTURE.md)."""

from __future__ import annotations

import time
from collections.abc import Iterable

from prism_edge.bus.session import Bus
from prism_edge.messages import Acknowledged


class Ledger:
    """Who has done which frame. Frames are done in order, so the newest index says it all."""

    def __init__(self, processes: Iterable[str]) -> None:
        """``processes`` take part in this run; what others say is ignored."""
        self._newest = dict.fromkeys(processes, -1)

    def note(self, acknowledged: Acknowledged) -> None:
        """Takes an acknowledgement; late and repeated ones change nothing."""
        newest = self._newest.get(acknowledged.process)
        if newest is not None:
            self._newest[acknowledged.process] = max(newest, acknowledged.index)

    def missing(self, index: int) -> set[str]:
        """The processes that have yet to do frame ``index``."""
        return {process for process, newest in self._newest.items() if newest < index}


class Gatekeeper:
    """The source's side: waits for the acknowledgements of a frame that it has released."""

    def __init__(self, bus: Bus, processes: Iterable[str], patience_s: float = 60.0) -> None:
        """Subscribes to acknowledgements; ``patience_s`` is how long a frame may take at most."""
        self._patience_s = patience_s
        self._ledger = Ledger(processes)
        self._inbox = bus.queue("acknowledged", 1024)

    def wait(self, index: int) -> set[str]:
        """Returns once everybody has done frame ``index``, or patience ends, or the bus is stopped.

        The answer names those still missing: empty if all is well.
        """
        deadline = time.monotonic() + self._patience_s
        while missing := self._ledger.missing(index):
            acknowledged = self._inbox.take(max(deadline - time.monotonic(), 0.0))
            if acknowledged is None:
                return missing
            self._ledger.note(acknowledged)
        return set()
