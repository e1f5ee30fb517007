"""A process that outlives the robot's daemon notices that the next one is another run."""

from __future__ import annotations

import threading

import pytest

from prism_edge.bus.another_run import AnotherRun
from tests.bus.tokens import Session


@pytest.mark.parametrize(
    ("tokens", "times"),
    [
        ([], 0),
        ([("a", True)], 0),
        ([("a", True), ("a", False)], 0),
        ([("a", True), ("a", False), ("a", True)], 0),
        ([("a", True), ("a", False), ("b", True)], 1),
        ([("a", True), ("b", True), ("a", False)], 1),
        ([("a", True), ("a", False), ("b", True), ("b", False), ("c", True)], 1),
    ],
    ids=["nobody", "one", "gone", "a link that was away", "the next", "an end told late", "once"],
)
def test_another_run_is_told_of_once(tokens, times):
    session, told = Session("prism/robot/internal/run"), []
    watch = AnotherRun(session, "robot", lambda: told.append(threading.current_thread().name))
    for run, there in tokens:
        session.says(run, there)
    watch.close()  # after all that was said
    assert told == ["another run"] * times
    assert not any(t.name == "another run" and t.is_alive() for t in threading.enumerate())


def test_each_listener_is_a_run_of_its_own(join):
    began = threading.Event()
    first, depth = join("supervisor", listen=True), join("depth")
    depth.on_another_run(began.set)
    depth.pulse.ready()
    assert first.await_ready(["depth"], 10.0) == set()
    assert not began.wait(0.3)
    first.close()
    assert not began.wait(0.3)
    join("supervisor", listen=True)
    assert began.wait(30.0)


def test_who_came_before_any_run_takes_the_first_for_its_own(join):
    began = threading.Event()
    depth = join("depth")
    depth.on_another_run(began.set)
    supervisor = join("supervisor", listen=True)
    depth.pulse.ready()
    assert supervisor.await_ready(["depth"], 10.0) == set()
    assert not began.wait(0.3)
