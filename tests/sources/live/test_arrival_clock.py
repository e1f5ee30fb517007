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


@pytest.mark.parametrize("counted", [-1e-3, -3e-3, -1e-2, -2e-2, -3e-2])
def test_a_sender_whose_stamps_run_slower_than_time_is_found(counted: float) -> None:
    """An encoder that counts 30 images to a second, of a camera that takes 29.97 to 29.1 of them."""
    rng, clock, arrived, found_s = np.random.default_rng(3), ArrivalClock(), 0, None
    early = []
    for k in range(3600):
        true = 1000 * S + k * S // 30
        arrived = max(arrived, true + round((5.0 + rng.exponential(10.0)) * MS))
        stamp = round((true - 1000 * S) * (1 + counted))
        clock.observe(stamp, arrived, awaited=k % 7 != 3)  # now and then two come together
        if clock.is_slow:
            found_s = found_s or k / 30
        elif found_s is None:
            early.append((true - clock.host_ns(stamp)) / MS)
    assert found_s is not None
    assert found_s < 30.0 + 0.1 / -counted
    assert max(early) < 25.0 + 5000.0 * -counted, "what the clocks part by in five seconds, beyond the bound"


@pytest.mark.parametrize("drift", [-100e-6, 0.0, 100e-6])
@pytest.mark.parametrize("jitter_ms", [0.0, 20.0, 60.0])
def test_drifting_clocks_and_busy_networks_are_no_slow_sender(drift: float, jitter_ms: float) -> None:
    rng, clock, arrived = np.random.default_rng(5), ArrivalClock(), 0
    for k in range(12 * 600):  # ten minutes at 12 Hz
        true = k * S // 12
        congested = 40.0 if k // 240 % 3 == 1 else 0.0  # for twenty seconds of each minute
        arrived = max(arrived, true + round((5.0 + congested + rng.exponential(jitter_ms)) * MS))
        clock.observe(round(true * (1 + drift)), arrived)
        assert not clock.is_slow


def test_a_step_of_the_sender_s_is_forgotten_in_seconds() -> None:
    clock = ArrivalClock()
    for k in range(600):
        stamp, arrival = k * 33 * MS - (400 * MS if k >= 300 else 0), k * 33 * MS + 5 * MS
        clock.observe(stamp, arrival)
        if k >= 300 + 160:
            assert clock.host_ns(stamp) == arrival
    assert not clock.is_slow


def test_a_decoder_that_falls_behind_is_no_slow_sender() -> None:
    """What waits for us is taken up later and later, and was there in time."""
    clock = ArrivalClock()
    for k in range(800):
        clock.observe(k * 33 * MS, round(k * 34.0 * MS) + MS, awaited=False)
    assert not clock.is_slow
    assert clock.host_ns(799 * 33 * MS) == 799 * 33 * MS + MS


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
