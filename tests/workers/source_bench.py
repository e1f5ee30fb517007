"""What the tests of the source worker share: a bus that keeps real time, and the worker in its thread."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from prism_edge.bus.warnings import Warnings
from prism_edge.config import Config, SourceConfig
from prism_edge.messages import Acknowledged, EndOfStream, Frame
from prism_edge.workers.source import main
from tests.workers.fake_desk import FakeDesk

DEADLINE_S = 30.0


class Box:
    """An Inbox without a network."""

    def __init__(self, stopped: threading.Event) -> None:
        self._messages: queue.Queue[Any] = queue.Queue()
        self._stopped = stopped
        self.put = self._messages.put

    def take(self, timeout_s: float = 0.0) -> Any | None:
        deadline = time.monotonic() + timeout_s
        while not self._stopped.is_set():
            try:
                return self._messages.get(timeout=max(0.001, min(0.02, timeout_s)))
            except queue.Empty:
                if time.monotonic() >= deadline:
                    return None
        return None


class Recorder:
    """Stands in for the bus: keeps what is published, delivers what a test says."""

    def __init__(self) -> None:
        self.life = 0
        self.run_directory: Path | None = None
        self.stopped = threading.Event()
        self.published: queue.Queue[tuple[str, Any]] = queue.Queue()
        self.states: list[str] = []
        self.budgets: dict[str, float] = {}  # of what was worked on, seconds
        self.boxes: dict[str, Box] = {}
        self._ready: set[str | None] = set()
        self.desk = FakeDesk()
        self.commands = self.desk.open
        values: dict[str, str] = {}
        self.pulse = SimpleNamespace(
            values=values,
            warn=Warnings(values),
            ready=lambda: self.states.append("ready"),
            working=self._working,
            idle=lambda: self.states.append("idle"),
            ended=lambda: self.states.append("ended"),
        )

    def _working(self, activity: str, budget_s: float = 5.0) -> None:
        self.states.append("working")
        self.budgets[activity] = budget_s

    def queue(self, topic: str, capacity: int = 256) -> Box:
        return self.boxes.setdefault(topic, Box(self.stopped))

    def publish(self, topic: str, message: Any) -> None:
        self.published.put((topic, message))

    def say(self, topic: str, message: Any) -> None:
        self.queue(topic).put(message)

    def await_ready(self, processes: set[str], timeout_s: float) -> set[str]:
        wanted, deadline = set(processes), time.monotonic() + timeout_s
        while not wanted <= self._ready:
            said = self.queue("ready").take(0.02)
            self._ready.add(said)  # what was said in time counts, however late we come to it
            if said is None and (time.monotonic() >= deadline or self.stopped.is_set()):
                break
        return wanted - self._ready

    def next(self) -> tuple[str, Any]:
        return self.published.get(timeout=DEADLINE_S)

    def until_end(self) -> tuple[list[Frame], EndOfStream]:
        frames = []
        while True:
            topic, message = self.next()
            if topic == "end":
                return frames, message
            assert topic == "frame"
            frames.append(message)


@contextmanager
def running(work: Callable[[Recorder], None]) -> Iterator[Recorder]:
    """Runs ``work`` in a thread; it must end soon after the bus is stopped, and without an error."""
    bus = Recorder()
    errors: list[BaseException] = []

    def body() -> None:
        try:
            work(bus)
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=body, daemon=True)
    thread.start()
    try:
        yield bus
    finally:
        bus.stopped.set()
        thread.join(DEADLINE_S)
    assert not thread.is_alive()
    assert not errors, errors


def settings(folder: Path, mode: str = "realtime", **source: Any) -> Config:
    values = {"peers_s": 0.0} | source
    return Config(mode=mode, source=SourceConfig(uri=str(folder), **values))


def playing(config: Config) -> Any:
    return running(lambda bus: main(config, bus))  # type: ignore[arg-type]


def undisturbed(work: Callable[[Recorder], None]) -> tuple[list[Frame], EndOfStream, Recorder]:
    """What is played, of five tries the first in which no frame was late, or the last."""
    for _ in range(5):
        with running(work) as bus:
            frames, end = bus.until_end()
        if bus.pulse.values["skipped"] == "0":
            break
    return frames, end, bus


OTHERS = ("tracker", "scale", "backend")  # that run where there is no network


def acknowledging(bus: Recorder, *names: str) -> tuple[list[Frame], EndOfStream]:
    frames = []
    while True:
        topic, message = bus.next()
        if topic == "end":
            return frames, message
        frames.append(message)
        for name in names:
            bus.say("acknowledged", Acknowledged(name, message.index))
