"""Heartbeats."""

from __future__ import annotations

import os
import time

import pytest

from prism_edge.bus import pulse as module
from prism_edge.bus.pulse import Pulse
from prism_edge.errors import BusError
from prism_edge.supervisor.liveness import ALIVE, judge
from tests.waiting import until


@pytest.fixture
def sent():
    return []


@pytest.fixture
def announced():
    return []


@pytest.fixture
def between_beats(monkeypatch):
    """No regular beat for an hour: what is heard of sooner was said at once, however slow the machine."""
    monkeypatch.setattr(module, "PERIOD_S", 3600.0)
    monkeypatch.setattr(module, "FIRST_PERIOD_S", 3600.0)


@pytest.fixture
def pulse(sent, announced):
    pulse = Pulse("depth", sent.append, lambda: announced.append("ready"))
    yield pulse
    pulse.close()


def test_a_process_begins_by_starting(pulse, sent):
    until(lambda: sent)
    assert (sent[0].process, sent[0].pid, sent[0].state) == ("depth", os.getpid(), "starting")


def test_it_beats_on_without_being_asked(pulse, sent):
    until(lambda: len(sent) >= 3)
    assert sent[2].monotonic_ns > sent[1].monotonic_ns > sent[0].monotonic_ns


def test_ready_is_announced_once_and_said_at_once(between_beats, pulse, sent, announced):
    pulse.ready()
    pulse.ready()
    assert announced == ["ready"]
    until(lambda: sent and sent[-1].state == "ready")


def test_ended_is_said_at_once_and_not_again_until_there_is_more(between_beats, pulse, sent):
    pulse.ended()
    until(lambda: sent and sent[-1].state == "ended")
    since = pulse._doing
    pulse.ended()
    assert pulse._doing is since
    pulse.idle()
    pulse.ended()
    assert pulse._doing is not since


def test_an_activity_carries_its_start_and_budget(pulse):
    pulse.ready()
    before = time.monotonic_ns()
    pulse.working("inference", 3.0)
    beat = pulse.beat()
    assert (beat.state, beat.activity, beat.budget_s) == ("working", "inference", 3.0)
    assert before <= beat.activity_since_ns <= beat.monotonic_ns
    pulse.idle()
    assert (pulse.beat().state, pulse.beat().activity) == ("idle", "")


def test_long_work_is_said_before_it_begins(between_beats, pulse, sent):
    until(lambda: sent)
    pulse.ready()
    until(lambda: sent[-1].state == "ready")
    pulse.working("tracking", 5.0)
    pulse.idle()
    pulse.working("a global adjustment", 20.0)
    # Of what is said by the caller itself nothing has to be waited for, nor could it be in native code.
    assert (sent[-1].state, sent[-1].activity, sent[-1].budget_s) == ("working", "a global adjustment", 20.0)
    assert [beat.activity for beat in sent[:-1]] == [""] * (len(sent) - 1)


def test_work_before_ready_is_a_part_of_starting(pulse):
    pulse.working("loading the network", 30.0)
    beat = pulse.beat()
    assert (beat.state, beat.activity, beat.budget_s) == ("starting", "loading the network", 30.0)


def test_a_wait_before_ready_has_the_budget_of_a_start(pulse):
    """Of none it would be overdue at once, and the process killed while it starts."""
    pulse.idle()
    beat = pulse.beat()
    assert beat.state == "starting"
    assert judge(beat, 30.0).liveness == ALIVE


def test_values_are_copied_as_text(pulse):
    pulse.values["queue"] = 3
    beat = pulse.beat()
    pulse.values["queue"] = 4
    assert beat.values == {"queue": "3"}


def test_what_is_warned_of_is_in_the_beat_while_it_stands(pulse):
    pulse.warn("speed", "too slow")
    assert pulse.beat().values == {"warning": "too slow"}
    pulse.warn("speed", "")
    assert pulse.beat().values == {}


def test_counters(pulse):
    assert [pulse.count("malformed"), pulse.count("malformed")] == [1, 2]
    assert pulse.values == {"malformed": "2"}


def test_a_beat_that_can_not_be_sent_does_not_end_the_thread():
    calls = []

    def fail(beat):
        calls.append(beat)
        raise BusError("no")

    pulse = Pulse("depth", fail, lambda: None)
    until(lambda: len(calls) >= 2)
    pulse.close()


def test_close_ends_the_thread(pulse, sent):
    pulse.close()
    pulse._thread.join(30.0)  # close() itself waits no longer than a second
    assert not pulse._thread.is_alive()
    count = len(sent)
    pulse.ready()
    assert len(sent) == count
