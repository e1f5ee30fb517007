"""Stamps of another clock in the host's time, against simulated networks whose true times are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.sources.live.arrival_clock import ArrivalClock

MS = 1_000_000
S = 1_000_000_000


def errors(drift: float, jitter_ms: float, least_ms: float, seconds: float, seed: int) -> np.ndarray:
    """Estimated less true capture times (ms) at 30 Hz, the first three seconds left out."""
    rng = np.random.default_rng(seed)
    clock, found, arrived = ArrivalClock(), [], 0
    for k in range(round(seconds * 30)):
        true = 1000 * S + k * S // 30
        arrived = max(arrived, true + round((least_ms + rng.exponential(jitter_ms)) * MS))  # in order, as TCP
        stamp = round((true - 1000 * S) * (1 + drift)) + 77
        clock.observe(stamp, arrived)
        found.append((clock.host_ns(stamp) - true) / MS)
    return np.array(found[90:])


@pytest.mark.parametrize("drift", [-100e-6, 0.0, 100e-6])
def test_jitter_goes_and_the_least_delay_stays(drift: float) -> None:
    late = errors(drift, jitter_ms=20.0, least_ms=5.0, seconds=120.0, seed=1)
    # The clocks part by 3 ms in the window of 30 s; the network's 20 ms of jitter are all but gone.
    assert late.min() > 5.0 - 3.1
    assert late.max() < 5.0 + 3.1
    assert np.abs(np.diff(late)).max() < 3.0


def test_a_stall_dates_back_what_waited_in_it() -> None:
    clock = ArrivalClock()
    for k in range(30):
        clock.observe(k * 33 * MS, 5 * S + k * 33 * MS + MS)
    for k in range(30, 60):  # two seconds of silence, then all that had queued at once
        clock.observe(k * 33 * MS, 5 * S + 30 * 33 * MS + 2 * S)
        assert clock.host_ns(k * 33 * MS) == 5 * S + k * 33 * MS + MS


@pytest.mark.parametrize("leap_ns", [-100 * S, -600 * MS, 3600 * S])
def test_a_sender_that_starts_its_stamps_anew_is_a_new_clock(leap_ns: int) -> None:
    clock = ArrivalClock()
    for k in range(300):
        clock.observe(1000 * S + k * 33 * MS, k * 33 * MS)
    stamp, arrival = 1000 * S + 300 * 33 * MS + leap_ns, 300 * 33 * MS + 7
    clock.observe(stamp, arrival)
    assert clock.host_ns(stamp) == arrival


def test_pictures_sent_out_of_order_are_the_same_clock() -> None:
    clock = ArrivalClock()
    for k, shown in enumerate([0, 3, 1, 2, 6, 4, 5]):
        clock.observe(shown * 33 * MS, k * 33 * MS)
    # The one sent earliest against its place tells: 3 at time 1, 6 at time 4.
    assert clock.host_ns(0) == -2 * 33 * MS


def test_nothing_observed_yet() -> None:
    with pytest.raises(ValueError, match="observed"):
        ArrivalClock().host_ns(0)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(-(2**62), 2**62), st.integers(0, 10 * S)), min_size=1, max_size=30
    )
)
def test_whatever_stamps_come_no_image_is_from_the_future(pairs: list[tuple[int, int]]) -> None:
    clock, arrival = ArrivalClock(), 0
    for stamp, step in pairs:
        arrival += step
        clock.observe(stamp, arrival)
        assert clock.host_ns(stamp) <= arrival


def test_a_sender_whose_stamps_stood_still_is_a_new_clock() -> None:
    """They go on where they were, and fifteen seconds have gone by: by the old clock all would be late."""
    clock = ArrivalClock()
    for k in range(300):
        clock.observe(k * 33 * MS, k * 33 * MS + MS)
    stamp, arrival = 300 * 33 * MS, 300 * 33 * MS + 15 * S
    clock.observe(stamp, arrival)
    assert arrival - S < clock.host_ns(stamp) <= arrival
