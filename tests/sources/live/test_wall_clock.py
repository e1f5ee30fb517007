"""Stamps of a live camera, on clocks that are set here."""

from __future__ import annotations

import time

import pytest

from prism_edge.sources.live import wall_clock
from prism_edge.sources.live.wall_clock import WallClock

DAY_NS = 1_800_000_000_000_000_000
HOUR_NS = 3_600_000_000_000


class Clocks:
    """A computer's three clocks."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.wall_ns, self.monotonic_ns, self.slept_ns = DAY_NS, 5_000_000_000, 7_000_000_000
        patch.setattr(wall_clock.time, "time_ns", lambda: self.wall_ns)
        patch.setattr(wall_clock.time, "monotonic_ns", lambda: self.monotonic_ns)
        patch.setattr(wall_clock.time, "clock_gettime_ns", self.read)

    def read(self, clock: int) -> int:
        return self.monotonic_ns + (self.slept_ns if clock == time.CLOCK_BOOTTIME else 0)

    def go(self, ns: int) -> None:
        self.wall_ns += ns
        self.monotonic_ns += ns

    def sleep(self, ns: int) -> None:
        self.wall_ns += ns
        self.slept_ns += ns


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    return Clocks(monkeypatch)


def test_it_is_the_time_of_day(clocks: Clocks) -> None:
    clock = WallClock()
    clocks.go(40_000_000)
    assert clock.at(clocks.monotonic_ns) == clocks.wall_ns


def test_a_wall_clock_that_is_set_moves_nothing(clocks: Clocks) -> None:
    clock = WallClock()
    clocks.wall_ns += HOUR_NS
    assert clock.at(clocks.monotonic_ns) == DAY_NS


def test_a_computer_that_has_slept_goes_on_with_the_time_of_day(
    clocks: Clocks, caplog: pytest.LogCaptureFixture
) -> None:
    clock = WallClock()
    for _ in range(2):
        clocks.sleep(HOUR_NS)
        clocks.go(33_000_000)
        assert clock.at(clocks.monotonic_ns) == clocks.wall_ns
        assert clock.at(clocks.monotonic_ns) == clocks.wall_ns
    assert [record.getMessage() for record in caplog.records] == [
        "the computer has slept for 3600.0 s: stamps go on by as much"
    ] * 2


def test_clocks_that_are_not_read_at_once_are_no_sleep(clocks: Clocks) -> None:
    clock = WallClock()
    for _ in range(1000):
        clocks.slept_ns += 1000 if clocks.slept_ns % 2 else 999  # a microsecond apart, now and then
        clocks.go(33_000_000)
        assert clock.at(clocks.monotonic_ns) == clocks.wall_ns
