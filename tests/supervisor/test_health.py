"""What rows of health come to."""

from __future__ import annotations

from prism_edge.supervisor.health import ERROR, OK, STALE, WARN, Row, status_line, summary


def row(name: str, level: int, message: str = "", **values: str) -> Row:
    return Row(name, level, message, values)


def test_the_summary_names_what_is_in_trouble_and_the_worst_of_it() -> None:
    rows = [row("source", OK, "runs"), row("depth", STALE, "is silent"), row("scale", ERROR, "is gone")]
    told = summary(rows, 7, 1.5)
    assert (told.level, told.message) == (ERROR, "depth is silent; scale is gone")
    assert told.values == {"state": "ready", "pid": "7", "ready_s": "1.500"}


def test_where_nothing_is_the_summary_is_the_state() -> None:
    rows = [row("source", OK, "runs")]
    assert (summary(rows, 7, None).level, summary(rows, 7, None).message) == (OK, "starting")
    assert summary(rows, 7, 1.5).message == "ready"


def test_the_run_in_one_line() -> None:
    rows = [
        row("supervisor", WARN, "depth is silent"),
        row("tracker", OK, odometry="tracking", map="home", keyframes="12"),
        row("source", OK, fps="29.9"),
    ]
    assert status_line(rows) == "depth is silent, tracking home, 29.9 images/s, 12 keyframes"
    assert status_line(rows[:1]) == "depth is silent"
