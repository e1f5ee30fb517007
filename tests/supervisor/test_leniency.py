"""A supervisor that stood still itself takes no silence for a hang; by a clock of the test's."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from prism_edge.config import Config
from prism_edge.messages import Heartbeat
from prism_edge.supervisor import supervisor as module
from prism_edge.supervisor.liveness import QUIET_S
from prism_edge.supervisor.supervisor import Supervisor
from tests.supervisor.fake_daemon import cast
from tests.supervisor.test_watch import beat


class Looking:
    """A supervisor of one process, which looks when the test says so; without a bus."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s, self.heard, self.kills = 0.0, list[Heartbeat](), 0
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        self.run = run = Supervisor(Config(), *cast(["depth:steady"]))
        run._heartbeats = SimpleNamespace(take=lambda timeout_s: None, drain=self._drain)
        run._directory = SimpleNamespace(keep=lambda: None)
        run._desk = SimpleNamespace(serve=lambda: None)
        monkeypatch.setattr(run, "_publish", lambda now_s: None)
        run._children["depth"] = SimpleNamespace(pid=100, poll=lambda: None, kill=self._kill)
        run._watches["depth"].started(100, 0.0)

    def _drain(self) -> list[Heartbeat]:
        heard, self.heard = self.heard, []
        return heard

    def _kill(self) -> None:
        self.kills += 1

    def look(self, at_s: float, *heard: Heartbeat) -> None:
        self.now_s, self.heard = at_s, list(heard)
        self.run._look()


@pytest.fixture
def looking(monkeypatch: pytest.MonkeyPatch) -> Looking:
    """Ready, and heard of until one second."""
    looking = Looking(monkeypatch)
    for at_s in (0.5, 1.0):
        looking.look(at_s, beat(100, "idle"))
    return looking


def test_what_was_stopped_with_us_is_given_time_to_be_heard_of(looking: Looking) -> None:
    """A suspended computer: an hour later all are silent for an hour, and none hangs."""
    looking.look(3600.0)
    looking.look(3600.1)
    assert looking.kills == 0
    looking.look(3600.5, beat(100, "idle"))
    looking.look(3600.5 + QUIET_S)
    assert looking.kills == 0


def test_what_stays_silent_after_that_hangs(looking: Looking) -> None:
    looking.look(3600.0)
    for tenths in range(1, 10 * round(QUIET_S)):
        looking.look(3600.0 + 0.1 * tenths)
    assert looking.kills == 0
    looking.look(3600.1 + QUIET_S)
    assert looking.kills == 1


def test_silence_that_we_were_awake_for_is_a_hang(looking: Looking) -> None:
    for tenths in range(1, 1000):
        looking.look(1.0 + 0.1 * tenths)
    assert looking.kills > 0


def test_what_does_not_end_though_it_was_killed_is_said_once(
    looking: Looking, caplog: pytest.LogCaptureFixture
) -> None:
    """A driver holds it; whenever that lets go, it has been killed."""
    for tenths in range(1, 200):
        looking.look(1.0 + 0.1 * tenths)
    assert looking.kills > 10
    assert len([record for record in caplog.records if "hangs" in record.getMessage()]) == 1
