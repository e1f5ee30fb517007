"""A stream that is decoded too slowly, against a decoder that checks what it is given."""

from __future__ import annotations

from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from prism_edge.sources.live import stream
from prism_edge.sources.live.backlog import Backlog
from prism_edge.sources.live.stream import Options, StreamConnection

MS = 1_000_000
PERIOD_MS, KEY_EVERY = 33, 15


class Simulation:
    """Packets every 33 ms by their stamps, each taking ``cost_ms`` to decode; time is simulated."""

    def __init__(self, cost_ms: float, real_period_ms: float) -> None:
        self.cost_ms, self.real_period_ms, self.now_ns = cost_ms, real_period_ms, 0
        self.decoded: list[int] = []
        video = SimpleNamespace(
            codec_context=SimpleNamespace(thread_count=0), average_rate=Fraction(30), thread_type=""
        )
        streams = SimpleNamespace(video=[video])
        self.container = SimpleNamespace(streams=streams, demux=lambda _: self._packets())

    def _packets(self) -> Any:
        k = 0
        while True:
            # waits for it, or has it queued already
            self.now_ns = max(self.now_ns, round(k * self.real_period_ms * MS))
            yield self._packet(k)
            k += 1

    def _packet(self, k: int) -> Any:
        def decode() -> list[Any]:
            assert k % KEY_EVERY == 0 or self.decoded[-1] == k - 1, "it builds on a picture that was left out"
            self.decoded.append(k)
            self.now_ns += round(self.cost_ms * MS)
            return [SimpleNamespace(is_corrupt=False, key_frame=k % KEY_EVERY == 0, **stamp)]

        stamp = {"pts": k * PERIOD_MS, "time_base": Fraction(1, 1000)}
        return SimpleNamespace(size=100, is_keyframe=k % KEY_EVERY == 0, decode=decode, **stamp)


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> Any:
    def make(cost_ms: float, real_period_ms: float = PERIOD_MS) -> tuple[Simulation, StreamConnection]:
        simulation = Simulation(cost_ms, real_period_ms)
        monkeypatch.setattr(stream.time, "monotonic_ns", lambda: simulation.now_ns)
        return simulation, StreamConnection(simulation.container, Options(), False)

    return make


def test_a_decoder_that_keeps_up_gets_everything(simulated: Any) -> None:
    simulation, connection = simulated(30.0)
    grabs = [connection.grab() for _ in range(300)]
    assert len(simulation.decoded) == 300
    assert all(grab.missed == 0 for grab in grabs)


def test_a_decoder_that_is_too_slow_skips_to_key_frames_and_never_falls_far_behind(simulated: Any) -> None:
    simulation, connection = simulated(60.0)
    index, late_ms = -1, []
    while simulation.now_ns < 60_000 * MS:
        grab = connection.grab()
        if grab is not None:
            index += 1 + grab.missed
            assert index == simulation.decoded[-1]  # what was left out shows as gaps
            assert grab.captured_ns == index * PERIOD_MS * MS
            late_ms.append((simulation.now_ns - grab.captured_ns) / MS)
    assert max(late_ms) < 1_000 + 2 * 60
    assert min(late_ms[len(late_ms) // 2 :]) < 400  # it catches up, again and again
    assert len(simulation.decoded) > 0.8 * 60_000 / 60


def test_one_pause_is_caught_up_with(simulated: Any) -> None:
    simulation, connection = simulated(5.0)
    for _ in range(20):
        connection.grab()
    simulation.now_ns += 3_000 * MS  # the machine slept
    for _ in range(200):
        connection.grab()
    assert simulation.decoded[-1] == 219
    assert len(simulation.decoded) < 200


@pytest.mark.parametrize("real_period_ms", [35.0, 41.25, 80.0, 400.0])
def test_stamps_that_run_slower_than_time_cost_no_image(
    simulated: Any, real_period_ms: float, caplog: pytest.LogCaptureFixture
) -> None:
    """An encoder that counts 30 images a second, though its camera takes fewer in the dark."""
    simulation, connection = simulated(10.0, real_period_ms)
    ages_ms, captured_ns = [], []
    for _ in range(1500):
        grab = connection.grab()
        captured_ns.append(grab.captured_ns)
        ages_ms.append((simulation.now_ns - grab.captured_ns) / MS)
    assert len(simulation.decoded) == 1500
    assert caplog.text.count("stamps run slower") == 1
    np.testing.assert_allclose(ages_ms[-500:], 10.0, atol=0.001)  # what decoding takes, and no more
    steps = np.diff(captured_ns[-500:]) / MS
    np.testing.assert_allclose(steps, real_period_ms, rtol=0.05)


def test_the_choice() -> None:
    backlog = Backlog()
    for _ in range(5):
        assert not backlog.leaves_out(900 * MS, 0, False)
    assert backlog.leaves_out(1100 * MS, 0, False)
    assert not backlog.leaves_out(1000 * MS, 0, True)
    assert backlog.leaves_out(100 * MS, 0, False)  # in time again, but its forerunner was left out
    assert not backlog.leaves_out(100 * MS, 0, True)
    assert not backlog.leaves_out(100 * MS, 0, False)


def test_what_had_to_be_waited_for_is_no_backlog() -> None:
    backlog = Backlog()
    for _ in range(49):
        assert not backlog.leaves_out(1100 * MS, 30 * MS, False)
        assert not backlog.misled  # behind a link that was held up a late packet may have to be waited for
    assert not backlog.leaves_out(1100 * MS, 30 * MS, False)
    assert backlog.misled


def test_one_stall_of_the_network_does_not_make_the_stamps_run_slow() -> None:
    backlog = Backlog()
    for _ in range(300):
        assert not backlog.leaves_out(5 * MS, 30 * MS, False)
    assert not backlog.leaves_out(1500 * MS, 1500 * MS, False)  # the first that gets through; the rest waits
    assert not backlog.misled
