"""What `watch` works out: speed, rate, latency."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.cli.live_view import LiveView

MS = 1_000_000


def test_speed_of_a_steady_walk_is_found_by_the_recordings_time() -> None:
    view = LiveView()
    for i in range(60):
        view.add_odometry(i * 33 * MS, (0.6 * i * 0.033, 0.8 * i * 0.033, 0.0), 0)
    assert view.speed == pytest.approx(1.0)


def test_recording_that_begins_again_gives_no_wild_speed() -> None:
    view = LiveView()
    for stamp in (1000 * MS, 1033 * MS, 0):
        view.add_odometry(stamp, (float(stamp), 0.0, 0.0), 0)
    assert view.speed is None
    view.add_odometry(100 * MS, (0.1, 0.0, 0.0), 0)
    assert view.speed == pytest.approx(1.0)


def test_rate_counts_the_last_moments_only() -> None:
    view = LiveView()
    for i in range(90):
        view.add_pose(i, (0, 0, 0), 0.1, i * 40 * MS)
    assert view.rate_hz(89 * 40 * MS) == pytest.approx(25.0)
    assert view.rate_hz(60_000 * MS) == 0.0


def test_no_rate_is_told_of_one_burst() -> None:
    view = LiveView()
    assert dict(view.rows(0))["rate"] == "-"
    for i in range(9):  # what waited
        view.add_pose(i, (0, 0, 0), 0.1, i)
    assert dict(view.rows(10))["rate"] == "-"
    view.add_pose(9, (0, 0, 0), 0.1, 499 * MS)
    assert dict(view.rows(499 * MS))["rate"] == "-"
    view.add_pose(10, (0, 0, 0), 0.1, 500 * MS)
    assert dict(view.rows(500 * MS))["rate"] == "20.0 Hz"


@pytest.mark.parametrize("release_first", [True, False])
def test_latency_is_arrival_less_capture_in_either_order(release_first: bool) -> None:
    view = LiveView()
    for i in range(20):
        captured, arrival = i * 33 * MS, i * 33 * MS + 12 * MS
        steps = [
            lambda c=captured, i=i: view.add_release(i, c),
            lambda a=arrival, i=i: view.add_pose(i, (0, 0, 0), 0.1, a),
        ]
        for step in steps if release_first else reversed(steps):
            step()
    assert view.latency_ms == pytest.approx(12.0)


def test_what_is_not_known_is_a_dash() -> None:
    view = LiveView()
    assert dict(view.rows(0))["latency"] == dict(view.rows(0))["speed"] == dict(view.rows(0))["scale"] == "-"
    view.scale, view.scale_sigma = 1.05, 0.1
    assert dict(view.rows(0))["scale"] == "1.050 ± 0.105"
    view.add_pose(0, (1.0, -2.0, 3.0), math.nan, 0)
    assert dict(view.rows(0))["sigma"] == "-"
    assert "x +1.000 y -2.000 z +3.000 m" in view.line(0)


def walk(view: LiveView, seconds: int) -> int:
    """A metre a second at 30 Hz, 20 ms late; returns when the last pose came."""
    arrival = 0
    for i in range(30 * seconds):
        captured = i * 1000 * MS // 30
        arrival = captured + 20 * MS
        view.add_odometry(captured, (captured * 1e-9, 0.0, 0.0), arrival)
        view.add_release(captured, captured)
        view.add_pose(captured, (captured * 1e-9, 0.0, 0.0), 0.1, arrival)
    return arrival


def test_a_daemon_that_has_gone_is_not_shown_as_if_it_went_on() -> None:
    view = LiveView()
    view.add_state("ok building", 0)
    last = walk(view, 5)
    now = dict(view.rows(last + 500 * MS))
    assert (now["speed"], now["latency"], now["state"]) == ("1.00 m/s", "20.0 ms", "ok building")
    now = dict(view.rows(last + 2500 * MS))
    assert (now["speed"], now["latency"], now["rate"], now["state"]) == ("-", "-", "0.0 Hz", "ok building")
    now = dict(view.rows(last + 12_000 * MS))
    assert now["state"] == "nothing heard for 12 s; last: ok building"
    view.add_state("lost relocalising", last + 12_000 * MS)
    assert dict(view.rows(last + 12_500 * MS))["state"] == "lost relocalising"


@pytest.mark.parametrize("release_first", [True, False])
def test_a_latency_of_seconds_is_shown_when_it_is_known(release_first: bool) -> None:
    view = LiveView()
    if release_first:
        view.add_release(0, 0)
    view.add_pose(0, (0, 0, 0), 0.1, 5000 * MS)
    if not release_first:
        view.add_release(0, 0)
    assert dict(view.rows(5100 * MS))["latency"] == "5000.0 ms"


@given(st.lists(st.tuples(st.integers(0, 10**12), st.booleans()), max_size=300))
@settings(max_examples=30, deadline=None)
def test_any_order_of_messages_is_survived_and_memory_bounded(events: list[tuple[int, bool]]) -> None:
    view = LiveView()
    for stamp, released in events:
        if released:
            view.add_release(stamp, stamp)
        else:
            view.add_pose(stamp, (0, 0, 0), 0.1, stamp)
            view.add_odometry(stamp, (0, 0, 0), stamp)
    assert view.speed is None or view.speed >= 0
    assert len(view._released) <= 256
    assert len(view._waiting) <= 256
    assert view.line(0)
