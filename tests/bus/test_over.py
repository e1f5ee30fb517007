"""What was begun for one run of the robot is not told to the next, whose keyframes have the same numbers."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from prism_edge.bus.session import Bus
from prism_edge.messages import Epoch
from tests.bus.examples import end


class Between:
    """A process that was started by hand, as the robot has begun another run."""

    def __init__(self, join: Callable[..., Bus], prepare: Callable[[Bus], None]) -> None:
        began = threading.Event()
        first, self.remote = join("supervisor", listen=True), join("source")
        prepare(self.remote)
        self.remote.on_another_run(began.set)
        self.remote.pulse.ready()
        assert first.await_ready(["source"], 10.0) == set()
        first.close()
        self.robot = join("supervisor", listen=True)
        self.heard, self.beats = self.robot.queue("new_map"), self.robot.queue("heartbeat")
        assert began.wait(30.0)
        self.is_heard()

    def is_heard(self) -> None:
        self.beats.drain()
        assert self.beats.take(10.0) is not None


def test_nothing_but_heartbeats(join: Callable[..., Bus]) -> None:
    between = Between(join, lambda bus: None)
    between.remote.publish("new_map", Epoch(3))
    assert between.heard.take(1.0) is None
    between.is_heard()


@pytest.mark.parametrize(
    "prepare", [lambda bus: bus.publish("end", end(3)), lambda bus: bus.answer("end", lambda: end(3))]
)
def test_no_answers(join: Callable[..., Bus], prepare: Callable[[Bus], None]) -> None:
    between = Between(join, prepare)
    assert between.robot.ask("end", 2.0) is None
    between.is_heard()


def test_who_waits_for_it_waits_for_its_next_life(join: Callable[..., Bus]) -> None:
    between = Between(join, lambda bus: None)
    assert between.robot.await_ready(["source"], 1.0) == {"source"}
    between.remote.pulse.ready()
    between.is_heard()
    assert between.robot.await_ready(["source"], 0.5) == {"source"}
    between.remote.close()
    join("source").pulse.ready()
    assert between.robot.await_ready(["source"], 10.0) == set()


def test_one_that_is_ready_too_late_does_not_say_so(join: Callable[..., Bus]) -> None:
    began = threading.Event()
    first, remote = join("supervisor", listen=True), join("source")
    remote.on_another_run(began.set)
    heard = first.queue("heartbeat")
    assert heard.take(10.0) is not None
    first.close()
    robot = join("supervisor", listen=True)
    beats = robot.queue("heartbeat")
    assert began.wait(30.0)
    remote.pulse.ready()
    beats.drain()
    assert beats.take(10.0) is not None
    assert robot.await_ready(["source"], 1.0) == {"source"}
