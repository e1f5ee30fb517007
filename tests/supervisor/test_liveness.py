"""A hang is told from work, and from silence that means nothing."""

from __future__ import annotations

import pytest

from prism_edge.bus.pulse import LONG_S
from prism_edge.messages import Heartbeat
from prism_edge.supervisor.liveness import ALIVE, OVERDUE, QUIET, QUIET_S, SILENT_S, judge

SECOND = 1_000_000_000


def beat(state: str, since_s: float = 0.0, budget_s: float = 0.0, activity: str = "") -> Heartbeat:
    """A heartbeat sent ``since_s`` seconds after its activity began, by a clock that started elsewhere."""
    sent = 77 * SECOND
    return Heartbeat("depth", 1, sent, state, activity, sent - int(since_s * SECOND), budget_s, {})


def test_work_that_outlasts_the_patience_with_silence_is_said_before_it_begins() -> None:
    assert LONG_S <= SILENT_S


def test_nothing_is_held_against_a_process_never_heard() -> None:
    assert judge(None, 1e9).liveness == ALIVE


@pytest.mark.parametrize(
    ("age_s", "liveness"),
    [(0.0, ALIVE), (QUIET_S - 0.1, ALIVE), (QUIET_S + 0.1, QUIET), (SILENT_S + 0.1, OVERDUE)],
)
@pytest.mark.parametrize("state", ["ready", "idle", "ended"])
def test_silence_is_first_reported_then_deadly(state: str, age_s: float, liveness: str) -> None:
    assert judge(beat(state), age_s).liveness == liveness


@pytest.mark.parametrize(
    ("since_s", "age_s", "liveness"),
    [
        (1.0, 0.0, ALIVE),
        (1.0, 8.0, ALIVE),  # silent, yet within the budget of 10 s: it may be holding the interpreter's lock
        (8.0, 1.5, ALIVE),
        (9.0, 1.5, OVERDUE),
        (11.0, 0.0, OVERDUE),  # its heartbeats go on, but the work hangs
    ],
)
def test_declared_work_has_its_whole_budget(since_s: float, age_s: float, liveness: str) -> None:
    verdict = judge(beat("working", since_s, 10.0, "inference"), age_s)
    assert verdict.liveness == liveness
    assert ("inference" in verdict.why) == (liveness == OVERDUE)


def test_starting_is_declared_work() -> None:
    assert judge(beat("starting", 0.0, 60.0), 30.0).liveness == ALIVE
    assert judge(beat("starting", 0.0, 60.0), 61.0).liveness == OVERDUE


def test_a_start_is_given_longer_where_that_is_asked_for_and_nothing_else_is() -> None:
    assert judge(beat("starting", 0.0, 60.0), 300.0, 240.0).liveness == ALIVE
    verdict = judge(beat("starting", 0.0, 60.0, "loading the network"), 301.0, 240.0)
    assert (verdict.liveness, "of 300.0 s" in verdict.why) == (OVERDUE, True)
    assert judge(beat("working", 0.0, 60.0), 61.0, 240.0).liveness == OVERDUE
