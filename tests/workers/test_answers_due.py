"""Which answer is taken in at which frame, in lockstep."""

from __future__ import annotations

import pytest

from prism_edge.config import LockstepConfig
from prism_edge.workers import answers_due
from prism_edge.workers.answers_due import AnswersDue
from tests.synthetic.messages import map_update
from tests.workers.list_bus import ListBus

TOPICS = ("depth", "log_scale", "map_update")
LAGS = LockstepConfig(depth_lag=2, map_lag=4)


class Answer:
    """What matters here of a depth or a scale."""

    def __init__(self, keyframe: int) -> None:
        self.keyframe = keyframe


@pytest.fixture
def bus() -> ListBus:
    return ListBus()


@pytest.fixture
def inboxes(bus):
    return {topic: bus.queue(topic) for topic in TOPICS}


@pytest.fixture
def due(bus, inboxes) -> AnswersDue:
    return AnswersDue(bus, inboxes, {"depth", "scale", "backend"}, LAGS)


def about(taken) -> list[tuple[str, int]]:
    return [(topic, a.based_on if topic == "map_update" else a.keyframe) for topic, a in taken]


def test_each_answer_is_taken_at_its_frame_and_not_before_however_early_it_came(due, inboxes):
    inboxes["depth"].waiting.append(Answer(7))
    inboxes["log_scale"].waiting.append(Answer(7))
    inboxes["map_update"].waiting.append(map_update(7, 1))
    due.keyframe(10, 7)
    taken = {index: about(due.take(index)) for index in range(10, 16)}
    assert taken[12] == [("depth", 7), ("log_scale", 7)]
    assert taken[14] == [("map_update", 7)]
    assert not taken[10] + taken[11] + taken[13] + taken[15]


def test_what_a_later_keyframe_asks_may_be_due_before_what_an_earlier_one_does(due, inboxes):
    for keyframe in (7, 8):
        inboxes["depth"].waiting.append(Answer(keyframe))
        inboxes["log_scale"].waiting.append(Answer(keyframe))
        inboxes["map_update"].waiting.append(map_update(keyframe, keyframe))
        due.keyframe(keyframe + 3, keyframe)
    taken = {index: about(due.take(index)) for index in range(10, 16)}
    assert taken[13] == [("depth", 8), ("log_scale", 8)]
    assert (taken[14], taken[15]) == ([("map_update", 7)], [("map_update", 8)])


def test_a_probe_is_answered_by_the_network_alone(due, inboxes):
    inboxes["depth"].waiting.append(Answer(-5))
    due.probe(3, -5)
    assert about(due.take(5)) == [("depth", -5)]
    assert not list(due.take(99))


def test_nobody_waits_for_a_process_that_does_not_run(bus, inboxes, monkeypatch, caplog):
    monkeypatch.setattr(answers_due, "PATIENCE_S", 0.02)
    due = AnswersDue(bus, inboxes, {"backend"}, LAGS)
    inboxes["map_update"].waiting.append(map_update(0, 1))
    due.keyframe(0, 0)
    assert about(due.take(4)) == [("map_update", 0)]
    assert not caplog.text


def test_what_is_forgotten_is_not_waited_for(due, monkeypatch, caplog):
    monkeypatch.setattr(answers_due, "PATIENCE_S", 0.02)
    due.keyframe(0, 0)
    due.forget()
    assert not list(due.take(50))
    assert not caplog.text
    due.keyframe(51, 1)
    assert not list(due.take(60))
    assert caplog.text.count("going on without") == 3, "the test would see a wait"


def test_the_wait_for_an_answer_has_a_budget_that_outlasts_its_patience(due, bus, inboxes, monkeypatch):
    """Else the watchdog would end a tracker whose neighbour alone is slow."""
    budgets = []
    monkeypatch.setattr(bus.pulse, "working", lambda activity, budget_s=0.0: budgets.append(budget_s))
    due.probe(3, -5)
    inboxes["depth"].waiting.append(Answer(-5))
    assert about(due.take(5)) == [("depth", -5)]
    assert len(budgets) == 1
    assert budgets[0] > answers_due.PATIENCE_S
