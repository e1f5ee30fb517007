"""When images are due, and stamps read from decimal seconds."""

from __future__ import annotations

from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.sources.base import Slot
from prism_edge.sources.schedule import CatchingUp, Schedule
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


def play(decode_ms: int, stalled_ms: int, count: int = 200) -> tuple[list[int], int, int]:
    """What is released of a recording at 100 Hz that stalls at its 20th image; its end, and delay (ms)."""
    schedule, catching_up = Schedule(start_ns=0, first=Slot(0, 0), period_ns=10 * MS), CatchingUp()
    now_ns, released = 0, []
    for index in range(count):
        slot = Slot(index, index * 10 * MS)
        now_ns = max(now_ns, schedule.due_ns(slot)) + (stalled_ms * MS if index == 20 else 0)
        late = schedule.is_late(slot, now_ns)
        if late and catching_up.skips(index, schedule.periods_late(slot, now_ns)):
            now_ns += decode_ms * MS
            continue
        if late:
            schedule = schedule.put_off(now_ns - schedule.due_ns(slot))
        assert not schedule.is_late(slot, now_ns)
        released.append(index)
        now_ns += decode_ms * MS
    return released, now_ns // MS, schedule.start_ns // MS


def test_a_stall_is_made_good_by_skipping() -> None:
    released, _, put_off_ms = play(decode_ms=2, stalled_ms=400)
    assert put_off_ms == 0
    assert released[:20] == list(range(20))
    assert 40 < 200 - len(released) < 60  # what was missed, and a quarter more, for skipping takes time too
    assert released[20:] == list(range(released[20], 200))


def test_what_decodes_too_slowly_is_played_slower() -> None:
    released, end_ms, put_off_ms = play(decode_ms=30, stalled_ms=0)
    assert len(released) == 190  # ten have shown that skipping is of no use
    assert end_ms == 200 * 30
    assert put_off_ms > 3000


def test_after_a_stall_that_skipping_can_not_make_good_it_goes_on() -> None:
    released, _, put_off_ms = play(decode_ms=9, stalled_ms=400)
    assert len(released) == 160
    assert 300 < put_off_ms < 400


def test_one_image_that_decodes_slowly_is_no_reason_to_play_slower() -> None:
    catching_up = CatchingUp()
    assert all(catching_up.skips(i, late) for i, late in enumerate([1.5, 4.0, 3.2, 2.4, 1.6]))
    assert catching_up.skips(9, 1.5)  # in time between, so this row is another
    assert not catching_up.given_up


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
