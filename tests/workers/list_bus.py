"""A bus of lists for one worker, which in the test's own thread ends once everything has been taken."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from prism_edge.bus import codec, ros
from prism_edge.bus.warnings import Warnings
from prism_edge.topics import TOPICS
from tests.workers.fake_desk import FakeDesk

DEADLINE_S = 30.0


class ListInbox:
    """Gives what it holds; once that is nothing, a wait on a driving inbox ends the run."""

    def __init__(self, bus: ListBus, topic: str, newest: bool) -> None:
        self.bus, self.topic, self.newest = bus, topic, newest
        self.waiting: deque[Any] = deque()
        self.rouses: ListInbox | None = None

    def take(self, timeout_s: float = 0.0) -> Any | None:
        if self.bus.stopped.is_set():
            return None
        if self.topic == "frame" and timeout_s == 0 and self.bus.in_time:
            return None
        if self.waiting:
            if self.newest and not self.bus.one_by_one:
                while len(self.waiting) > 1:
                    self.waiting.popleft()
            return self.waiting.popleft()
        if timeout_s > 0 and self.topic in self.bus.drivers:
            self.bus.idle_looks += 1
            if self.bus.idle_looks > self.bus.patience:
                self.bus.stopped.set()
        self.bus.stopped.wait(min(timeout_s, 0.002))
        return None

    def drain(self) -> list[Any]:
        return [self.waiting.popleft() for _ in range(len(self.waiting))]


class ListBus:
    """``drivers`` are the inboxes whose emptiness ends the run; ``hear`` answers what the worker says.

    Without drivers it runs until it is stopped: a worker in a thread of its own, whose test waits for what
    it says.
    Everything goes through the codec, so that what would be refused on the wire is refused here and
    arrays arrive as they do there: read-only.
    """

    def __init__(self, *drivers: str, patience: int = 12) -> None:
        self.stopped = threading.Event()
        self.drivers, self.patience, self.idle_looks = drivers, patience, 0
        self.in_time = True  # False: the next frame is there while one is worked on, not first when awaited
        self.one_by_one = True  # False: an inbox of the newest drops what is older, as the real one does
        self.life, self.first_id = 0, 0
        self.run_directory: Path | None = None
        self.sent: list[tuple[str, Any]] = []
        self.forgotten: list[str] = []
        self._said = threading.Condition()
        self.inboxes: dict[str, ListInbox] = {}
        self.answers: dict[str, Callable[[], Any]] = {}
        self.hear: Callable[[str, Any], None] = lambda topic, message: None
        self.states: list[str] = []
        self.budgets_s: dict[str, float] = {}
        self.desk = FakeDesk()
        self.commands = self.desk.open
        note = self.states.append
        values: dict[str, str] = {}
        self.pulse = SimpleNamespace(
            values=values,
            warn=Warnings(values),
            ready=lambda: note("ready"),
            idle=lambda: note("idle"),
            ended=lambda: note("ended"),
            working=self._working,
            count=self._count,
        )

    def _working(self, activity: str, budget_s: float = 5.0) -> None:
        self.states.append(activity)
        self.budgets_s[activity] = budget_s

    def _count(self, what: str) -> int:
        counted = int(self.pulse.values.get(what, "0")) + 1
        self.pulse.values[what] = str(counted)
        return counted

    def queue(self, topic: str, capacity: int = 256, rouses: ListInbox | None = None) -> ListInbox:
        inbox = self.inboxes.setdefault(topic, ListInbox(self, topic, newest=False))
        inbox.rouses = rouses
        return inbox

    def latest(self, topic: str) -> ListInbox:
        inbox = self.queue(topic)
        inbox.newest = True
        return inbox

    def answer(self, topic: str, function: Callable[[], Any]) -> None:
        self.answers[topic] = function

    def ask(self, topic: str, timeout_s: float = 1.0) -> Any | None:
        return None

    def await_ready(self, processes: set[str], timeout_s: float) -> set[str]:
        return set()

    def publish(self, topic: str, message: Any) -> None:
        kind = TOPICS[topic].type
        if isinstance(kind, str):
            message = ros.deserialise(kind, ros.serialise(kind, message))
        else:
            assert type(message) is kind
            message = codec.unpack(codec.pack(message), kind)
        with self._said:
            self.sent.append((topic, message))
            self._said.notify_all()
        self.hear(topic, message)

    def forget(self, topic: str) -> None:
        self.forgotten.append(topic)

    def publish_if_heard(self, topic: str, make: Callable[[], Any]) -> None:
        self.publish(topic, make())

    def give(self, topic: str, *messages: Any) -> None:
        """Puts messages where the worker finds them."""
        self.idle_looks = 0
        inbox = self.inboxes.setdefault(topic, ListInbox(self, topic, newest=False))
        kind = TOPICS[topic].type
        inbox.waiting.extend(codec.unpack(codec.pack(message), kind) for message in messages)

    def of(self, topic: str) -> list[Any]:
        """What the worker has said on a topic."""
        return [message for name, message in self.sent if name == topic]

    def wait_for(self, topic: str, count: int) -> None:
        """Returns once the worker, in another thread, has said so many messages on a topic."""
        with self._said:
            assert self._said.wait_for(lambda: len(self.of(topic)) >= count, DEADLINE_S)
