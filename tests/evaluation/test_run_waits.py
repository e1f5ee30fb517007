"""How long an evaluation waits, for what, and from when it counts; by a clock of the test's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from prism_edge.config import Config
from prism_edge.evaluation import run as evaluation
from prism_edge.evaluation.daemon import DaemonError
from prism_edge.messages import Heartbeat, MapSnapshot
from prism_edge.processes import processes_for

NONE = np.zeros(0, np.int64)
SETTLED = MapSnapshot(0, 1, True, 0.0, NONE, np.zeros((0, 4, 4)), NONE)
NS = 10**9


class Clock:
    """Stands still until somebody waits."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        monkeypatch.setattr(evaluation, "time", self)

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def heartbeats(but: str = "") -> list[Heartbeat]:
    """Of all processes but one: ready since second 1003, as each says at 1009."""
    names = [process.name for process in processes_for(Config()) if process.name != but]
    return [Heartbeat(name, 1, 1009 * NS, "ready", "", 1003 * NS, 5.0, {}) for name in names]


def listen(clock: Clock, frames: Callable[[float], int], beats: list[Heartbeat]) -> tuple[float | None, str]:
    """A run of 9 frames whose source has ended at once; ``frames`` have been tracked after so many seconds.

    Returns the seconds until it was ready, and what was measured.
    """
    began_s, done = clock.now_s, []

    class Recorder:
        position, ended = 0, object()
        wait = staticmethod(clock.sleep)
        frames = property(lambda self: frames(clock.now_s - began_s))
        complete = property(lambda self: self.frames >= 9)

        def poll(self) -> list[Heartbeat]:
            taken, beats[:] = list(beats), []
            return taken

    daemon: Any = SimpleNamespace(check=lambda: None, started_ns=1001 * NS)
    meter: Any = SimpleNamespace(
        name=lambda pid, name: None,
        begin=lambda: done.append("begin"),
        sample=lambda: None,
        end=lambda: done.append("end"),
    )
    quiet: Any = SimpleNamespace(at=lambda frames: None)
    recorder: Any = Recorder()
    results: Any = SimpleNamespace(begin=lambda: done.append("room"))
    return evaluation._listen(Config(), daemon, recorder, meter, quiet, results), " ".join(done)


def test_a_daemon_is_ready_from_when_the_last_process_was_not_from_when_it_said_so(clock: Clock) -> None:
    assert listen(clock, lambda s: int(s), heartbeats()) == (2.0, "room begin end")


def test_what_is_never_ready_is_measured_from_the_first_frame_all_the_same(clock: Clock) -> None:
    assert listen(clock, lambda s: int(s), heartbeats(but="backend")) == (None, "room begin end")


def test_last_frames_that_were_lost_are_not_waited_for_for_good(clock: Clock) -> None:
    listen(clock, lambda s: min(int(s), 5), heartbeats())
    assert clock.now_s - 1000.0 == pytest.approx(5.0 + evaluation._LAST_FRAME_S, abs=0.3)


def test_frames_that_still_come_after_the_end_are_waited_for(clock: Clock) -> None:
    """A tracker that is behind by minutes, as in a lockstep run on a small board."""
    listen(clock, lambda s: int(s / 8), heartbeats())
    assert clock.now_s - 1000.0 == pytest.approx(72.0, abs=0.3)


def test_the_map_is_taken_once_it_has_settled_or_as_it_is_at_the_deadline(clock: Clock) -> None:
    unsettled = replace(SETTLED, settled=False)
    answers = [None, unsettled, None, SETTLED]
    bus: Any = SimpleNamespace(ask=lambda topic: answers.pop(0) if answers else None)
    daemon: Any = SimpleNamespace(check=lambda: None)
    assert evaluation._settled(bus, daemon, 60.0) is SETTLED
    answers[:] = [None, unsettled]
    assert evaluation._settled(bus, daemon, 60.0) is unsettled
    assert clock.now_s > 1060.0


def test_a_daemon_that_dies_over_the_last_optimisation_is_not_waited_for(clock: Clock) -> None:
    def check() -> None:
        raise DaemonError("out of memory", 7)

    bus: Any = SimpleNamespace(ask=lambda topic: None)
    with pytest.raises(DaemonError, match="out of memory"):
        evaluation._settled(bus, SimpleNamespace(check=check), 60.0)
    assert clock.now_s < 1001.0
