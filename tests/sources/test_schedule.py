"""When images are due, and stamps read from decimal seconds."""

from __future__ import annotations

from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.sources.base import Slot
from prism_edge.sources.schedule import Schedule
from prism_edge.sources.stamps import at_rate, parse_seconds, usual_period_ns

MS = 1_000_000


def test_the_recordings_own_pace() -> None:
    schedule = Schedule(start_ns=1000 * MS, first=Slot(0, 70 * MS), period_ns=33 * MS)
    assert schedule.due_ns(Slot(0, 70 * MS)) == 1000 * MS
    assert schedule.due_ns(Slot(5, 270 * MS)) == 1200 * MS


def test_another_rate_ignores_the_stamps() -> None:
    schedule = Schedule(start_ns=0, first=Slot(3, 70 * MS), period_ns=33 * MS, rate_hz=10.0)
    assert schedule.due_ns(Slot(3, 70 * MS)) == 0
    assert schedule.due_ns(Slot(13, 9_000 * MS)) == 1000 * MS
    assert schedule.is_late(Slot(3, 70 * MS), 101 * MS)
    assert not schedule.is_late(Slot(3, 70 * MS), 99 * MS)


def test_late_is_more_than_one_period() -> None:
    schedule = Schedule(start_ns=0, first=Slot(0, 0), period_ns=33 * MS)
    assert not schedule.is_late(Slot(1, 33 * MS), 20 * MS)
    assert not schedule.is_late(Slot(1, 33 * MS), 66 * MS)
    assert schedule.is_late(Slot(1, 33 * MS), 67 * MS)


@given(st.integers(-(2**62), 2**62))
def test_stamps_are_read_to_the_nanosecond(stamp_ns: int) -> None:
    assert parse_seconds(str(Decimal(stamp_ns) / 10**9)) == stamp_ns
    assert parse_seconds(f"{Decimal(stamp_ns) / 10**9:e}") == stamp_ns


@pytest.mark.parametrize("text", ["", "soon", "nan", "inf", "-inf", "1e400", "1,5", "0x10", "1 2"])
def test_what_is_no_time(text: str) -> None:
    with pytest.raises(ValueError, match="no time"):
        parse_seconds(text)


def test_rates_and_periods() -> None:
    assert [at_rate(i, 30.0) for i in (0, 1, 2, 3, 30)] == [0, 33333333, 66666667, 100000000, 1000000000]
    assert usual_period_ns([0, 10, 20, 20, 15, 25, 1000], 33) == 10
    assert usual_period_ns([], 33) == 33
    assert usual_period_ns([5, 5, 4], 33) == 33
