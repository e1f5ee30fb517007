"""What rows of health come to."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from prism_edge.bus import ros
from prism_edge.config import Config
from prism_edge.supervisor.health import ERROR, OK, STALE, WARN, Row, no_network, status_line, summary
from prism_edge.supervisor.supervisor import Supervisor


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


def test_without_a_network_a_map_that_was_loaded_is_all_that_is_needed() -> None:
    assert (no_network().level, no_network(has_map=True).level) == (WARN, OK)
    assert "no map begins" in no_network().message
    assert no_network(has_map=True).message == "no network: the map was loaded"


@pytest.mark.parametrize(("odometry", "level"), [("initialising", WARN), ("lost", OK), ("ok", OK)])
def test_health_says_so_once_the_tracker_has_a_map(odometry: str, level: int) -> None:
    run, published = Supervisor(Config()), []
    run._watches = {"tracker": SimpleNamespace(row=lambda now: row("tracker", OK, odometry=odometry))}
    run._diagnostics = ros.diagnostics
    run._bus = SimpleNamespace(publish=lambda topic, message: published.append(message))
    run._publish(1.0)
    levels = {status.name: int(status.level) for status in published[0].status}
    assert levels["depth"] == levels["supervisor"] == level
