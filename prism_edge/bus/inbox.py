"""What has arrived on one topic, for the worker's own thread to take."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from prism_edge.bus.arriving import arriving, no_more
from prism_edge.vital import vital

# How long a waiting thread sleeps before it looks whether the process is to stop: a signal handler can't
# wake it safely.
_LOOK_S = 0.1


class Inbox:
    """Messages of one topic, newest only (capacity 1) or in order; unpacked in the thread that takes them.

    Zenoh's ring channel receives, so that a full inbox never holds up the network or the publisher: the
    oldest goes. A small thread moves samples from there to where a wait can have a timeout, which Zenoh's
    own ``recv`` lacks.
    """

    def __init__(
        self,
        subscriber: Any,
        capacity: int,
        unpack: Callable[[Any], Any | None],
        stopped: threading.Event,
        overflowed: Callable[[], None] | None = None,
        arrived: Callable[[], None] | None = None,
    ) -> None:
        """``unpack`` turns a sample into a message, or None for a malformed one (which it has counted).

        ``arrived`` and ``overflowed`` are called in the inbox's own thread.
        """
        self._subscriber, self._unpack = subscriber, unpack
        self._stopped, self._overflowed, self._arrived = stopped, overflowed, arrived
        self._roused = False
        self.arrived_ns = 0  # monotonic: when the message that take() returned last had arrived
        self._samples: deque[Any] = deque(maxlen=capacity)
        self._arrivals: deque[int] = deque(maxlen=capacity)  # of each of them
        self._arrival = threading.Condition(threading.Lock())
        self._thread = vital(self._receive, "inbox")
        self._thread.start()

    def take(self, timeout_s: float = 0.0) -> Any | None:
        """The next message, waiting at most ``timeout_s``; None if there is none, or the bus is stopped.

        Or if it was roused since it last returned, by what has arrived elsewhere.
        """
        deadline = time.monotonic() + timeout_s
        while not self._stopped.is_set():
            with self._arrival:
                while not self._samples:
                    left = deadline - time.monotonic()
                    if left <= 0 or self._roused or self._stopped.is_set():
                        self._roused = False
                        return None
                    self._arrival.wait(min(left, _LOOK_S))
                sample, self._roused = self._samples.popleft(), False
                self.arrived_ns = self._arrivals.popleft()
            message = self._unpack(sample)
            if message is not None:
                return message
        return None

    def rouse(self) -> None:
        """End a wait in :meth:`take`; from any thread."""
        with self._arrival:
            self._roused = True
            self._arrival.notify()

    def drain(self) -> list[Any]:
        """Everything that has arrived, in order."""
        with self._arrival:
            samples = list(self._samples)
            self._samples.clear()
            self._arrivals.clear()
        messages = (self._unpack(sample) for sample in samples)
        return [message for message in messages if message is not None]

    def close(self) -> None:
        """Ends the subscription and its thread."""
        no_more(self._subscriber, self._thread)

    def _receive(self) -> None:
        for sample in arriving(self._subscriber):
            with self._arrival:
                full = len(self._samples) == self._samples.maxlen
                self._samples.append(sample)
                self._arrivals.append(time.monotonic_ns())
                self._arrival.notify()
            if full and self._overflowed is not None:
                self._overflowed()
            if self._arrived is not None:
                self._arrived()
