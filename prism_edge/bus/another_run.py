"""Noticing that a robot has begun another run: for a process on another computer, which outlives its runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import zenoh

from prism_edge.bus import keys
from prism_edge.bus.arriving import arriving, no_more
from prism_edge.vital import vital


class AnotherRun:
    """Listens for the token of the run, and calls ``begins`` once where there comes another one's.

    Each run numbers its epochs and keyframes from 0, so what is known of one would be taken for the next
    one's. A link that was away brings the same token again.
    """

    def __init__(self, session: Any, robot: str, begins: Callable[[], None]) -> None:
        self._begins, self._run = begins, ""
        self._subscriber = session.liveliness().declare_subscriber(
            keys.run_key(robot, "*"), zenoh.handlers.FifoChannel(64), history=True
        )
        self._thread = vital(self._listen, "another run")
        self._thread.start()

    def close(self) -> None:
        """Ends the subscription and its thread."""
        no_more(self._subscriber, self._thread)

    def _listen(self) -> None:
        told = False
        for token in arriving(self._subscriber):
            if token.kind != zenoh.SampleKind.PUT or told:
                continue
            run = str(token.key_expr)
            told = self._run not in ("", run)
            self._run = run
            if told:
                self._begins()
