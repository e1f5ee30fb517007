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
        view.add_odometry(i * 33 * MS, (0.6 * i * 0.033, 0.8 * i * 0.033, 0.0))
    assert view.speed == pytest.approx(1.0)


def test_recording_that_begins_again_gives_no_wild_speed() -> None:
    view = LiveView()
    for stamp in (1000 * MS, 1033 * MS, 0):
        view.add_odometry(stamp, (float(stamp), 0.0, 0.0))
    assert view.speed is None
    view.add_odometry(100 * MS, (0.1, 0.0, 0.0))
    assert view.speed == pytest.approx(1.0)


def test_rate_counts_the_last_moments_only() -> None:
    view = LiveView()
    for i in range(90):
        view.add_pose(i, (0, 0, 0), 0.1, i * 40 * MS)
    assert view.rate_hz(89 * 40 * MS) == pytest.approx(25.0)
    assert view.rate_hz(60_000 * MS) == 0.0


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


@given(st.lists(st.tuples(st.integers(0, 10**12), st.booleans()), max_size=300))
@settings(max_examples=30, deadline=None)
def test_any_order_of_messages_is_survived_and_memory_bounded(events: list[tuple[int, bool]]) -> None:
    view = LiveView()
    for stamp, released in events:
        if released:
            view.add_release(stamp, stamp)
        else:
            view.add_pose(stamp, (0, 0, 0), 0.1, stamp)
            view.add_odometry(stamp, (0, 0, 0))
    assert view.speed is None or view.speed >= 0
    assert len(view._released) <= 256
    assert len(view._waiting) <= 256
    assert view.line(0)
