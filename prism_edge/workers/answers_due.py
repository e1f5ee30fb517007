"""Lockstep: at which frame the tracker takes in the others' answer to a keyframe."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from prism_edge.bus.inbox import Inbox
from prism_edge.bus.session import Bus
from prism_edge.config import LockstepConfig
from prism_edge.messages import MapUpdate

log = logging.getLogger("prism_edge.tracker")

PATIENCE_S = 30.0  # an answer that takes longer isn't coming
_FRAME_S = 5.0


class AnswersDue:
    """What was asked and when its answer is to be taken in, in the order in which they are due."""

    def __init__(
        self, bus: Bus, inboxes: Mapping[str, Inbox], peers: Collection[str], lags: LockstepConfig
    ) -> None:
        """``inboxes`` are by topic; only ``peers`` answer, each ``lags`` frames after it was asked."""
        self._bus, self._inboxes = bus, inboxes
        asked = (
            ("depth", "depth", lags.depth_lag),
            ("log_scale", "scale", lags.depth_lag),
            ("map_update", "backend", lags.map_lag),
        )
        self._lags = {topic: lag for topic, process, lag in asked if process in peers}
        self._due: list[tuple[int, str, int]] = []  # frame, topic, keyframe
        self._early: dict[tuple[str, int], Any] = {}

    def keyframe(self, index: int, keyframe: int) -> None:
        """A keyframe went out with frame ``index``: everybody answers."""
        self._ask(index, keyframe, self._lags)

    def probe(self, index: int, probe: int) -> None:
        """A picture of what a lost camera sees went out: the network alone answers."""
        self._ask(index, probe, ["depth"])

    def forget(self) -> None:
        """Nothing that was asked matters any more: the map is another one."""
        self._due.clear()
        self._early.clear()

    def take(self, index: int) -> Iterator[tuple[str, Any]]:
        """(topic, answer) of all due at frame ``index``, waited for; what never comes is left out."""
        while self._due and self._due[0][0] <= index:
            _, topic, keyframe = self._due.pop(0)
            answer = self._await(topic, keyframe)
            if answer is not None:
                yield topic, answer

    def _ask(self, index: int, about: int, topics: Collection[str]) -> None:
        self._due += [(index + self._lags[topic], topic, about) for topic in topics]
        self._due.sort(key=lambda due: due[0])

    def _await(self, topic: str, keyframe: int) -> Any | None:
        if (topic, keyframe) not in self._early:
            # Of others, which a starved machine keeps waiting too: no hang of this process.
            self._bus.pulse.working(f"waiting for {topic} of keyframe {keyframe}", PATIENCE_S + _FRAME_S)
        deadline = time.monotonic() + PATIENCE_S
        while (topic, keyframe) not in self._early:
            message = self._inboxes[topic].take(0.2)
            if message is not None:
                about = message.based_on if isinstance(message, MapUpdate) else message.keyframe
                self._early[topic, about] = message
            elif self._bus.stopped.is_set() or time.monotonic() > deadline:
                log.warning("no %s of keyframe %d: going on without", topic, keyframe)
                return None
        return self._early.pop((topic, keyframe))
