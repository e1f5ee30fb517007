"""Answers to get()s: the last value of a topic, a function's, one that is only made when it is asked for."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest

from prism_edge import messages as m
from prism_edge.bus import ros
from prism_edge.bus.answer import Answer
from prism_edge.bus.codec import pack
from tests.bus.examples import end, linked
from tests.waiting import until


def test_a_latched_topic_answers_with_its_last_value(join, outside):
    join("supervisor", listen=True)
    source, tracker = join("source"), join("tracker")
    linked(source, tracker)
    assert tracker.ask("end", 5.0) is None
    source.publish("end", end(3))
    source.publish("end", end(4))
    assert tracker.ask("end", 5.0) == end(4)
    replies = list(outside().get("prism/robot/internal/end", timeout=5.0))
    assert [reply.ok.payload.to_bytes() for reply in replies] == [pack(end(4))]


def test_what_no_longer_holds_is_told_to_nobody_until_the_next(join):
    join("supervisor", listen=True)
    source, tracker = join("source"), join("tracker")
    linked(source, tracker)
    source.forget("end")  # nothing was said yet
    source.publish("end", end(3))
    assert tracker.ask("end", 5.0) == end(3)
    source.forget("end")
    assert tracker.ask("end", 5.0) is None
    source.publish("end", end(4))
    assert tracker.ask("end", 5.0) == end(4)


def test_what_nobody_hears_is_made_when_it_is_asked_for(join):
    join("supervisor", listen=True)
    source, tracker = join("source"), join("tracker")
    linked(source, tracker)
    made: list[int] = []

    def make(count: int) -> m.EndOfStream:
        made.append(count)
        return end(count)

    for count in (3, 4):
        source.publish_if_heard("end", lambda count=count: make(count))
    assert made == []
    assert tracker.ask("end", 5.0) == end(4)
    assert made == [4]
    inbox = tracker.queue("end")
    until(lambda: source.publish_if_heard("end", lambda: make(5)) or end(5) in inbox.drain())
    assert tracker.ask("end", 5.0) == end(5)
    source.close()
    source.publish_if_heard("end", lambda: make(6))
    assert 6 not in made


def test_nobody_answers_for_a_process_that_is_not_there(join):
    assert join("tracker").ask("map_snapshot", 0.2) is None


def test_a_function_answers_from_its_own_thread(join):
    join("supervisor", listen=True)
    source, tracker = join("source"), join("tracker")
    callers = []
    answers = [end(1), None]

    def function():
        callers.append(threading.get_ident())
        return answers.pop(0)

    source.publish("end", end(0))
    source.answer("end", function)  # takes the place of the last value
    linked(source, tracker)
    assert tracker.ask("end", 5.0) == end(1)
    assert tracker.ask("end", 5.0) is None
    assert threading.get_ident() not in callers


def test_who_reads_all_of_a_robot_makes_no_process_pack_what_only_ours_ask_for(join, outside):
    join("supervisor", listen=True)
    source, tracker, asked = join("source"), join("tracker"), []
    source.answer("end", lambda: asked.append(1) or end(1))
    tracker.publish("status", ros.diagnostics(0, [("tracking", 0, "ok building", {})]))
    linked(source, tracker)
    read = outside()
    for everything in ("prism/robot/**", "prism/robot/internal/*"):
        keys = {str(reply.ok.key_expr) for reply in read.get(everything, timeout=5.0) if reply.ok}
        assert ("prism/robot/status" in keys) == everything.endswith("**")
        assert not any("internal" in key for key in keys)
    assert asked == []
    assert tracker.ask("end", 5.0) == end(1)


def test_a_function_that_fails_is_logged_and_answers_nothing(join, caplog):
    join("supervisor", listen=True)
    source, tracker = join("source"), join("tracker")
    source.answer("end", lambda: 1 / 0)
    linked(source, tracker)
    assert tracker.ask("end", 5.0) is None
    assert "internal/end: ZeroDivisionError: division by zero" in caplog.text


def test_where_there_is_no_memory_the_answering_thread_does_not_go_on():
    """A lock that the worker waits for may never be given back: its end is the process's (vital.py)."""

    def payload() -> bytes:
        raise MemoryError

    answer = SimpleNamespace(_own=False, _key="prism/robot/status", _payload=payload)
    with pytest.raises(MemoryError):
        Answer._reply(answer, SimpleNamespace(key_expr="prism/robot/**"))
