"""Who else is ready on the bus, and linked to this process: Zenoh's liveliness tokens."""

from __future__ import annotations

import threading
import time
from typing import Any

import zenoh

from prism_edge.bus import keys
from prism_edge.bus.arriving import arriving, no_more
from prism_edge.vital import vital

# How often a waiting thread looks whether the process is to stop: a signal handler can't wake it safely.
_LOOK_S = 0.1


class Presence:
    """The processes that are ready, kept up to date from its first question until the bus is closed.

    One subscription for all questions. With one for each, a process that was killed just as one was declared
    stayed ready for good: the end of its token overtook its beginning on the way to the session, which
    answers later subscriptions from what it was told (Zenoh 1.10.2).
    """

    def __init__(self, session: Any, robot: str, stopped: threading.Event) -> None:
        self._stopped = stopped
        self._ready: set[str] = set()
        self._change = threading.Condition()
        self._subscriber = session.liveliness().declare_subscriber(
            keys.ready_key(robot, "*"), zenoh.handlers.FifoChannel(64), history=True
        )
        self._thread = vital(self._listen, "presence")
        self._thread.start()

    def missing(self, wanted: set[str], timeout_s: float) -> set[str]:
        """Waits until all that are wanted are ready; returns those that are not, in time or by the stop."""
        deadline = time.monotonic() + timeout_s
        with self._change:
            while not wanted <= self._ready:
                left = deadline - time.monotonic()
                if left <= 0 or self._stopped.is_set():
                    break
                self._change.wait(min(left, _LOOK_S))
            return wanted - self._ready

    def close(self) -> None:
        """Ends the subscription and its thread."""
        no_more(self._subscriber, self._thread)

    def _listen(self) -> None:
        for token in arriving(self._subscriber):
            name = str(token.key_expr).rsplit("/", 1)[1]
            with self._change:
                (self._ready.add if token.kind == zenoh.SampleKind.PUT else self._ready.discard)(name)
                self._change.notify_all()
