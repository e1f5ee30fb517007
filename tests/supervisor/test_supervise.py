"""When a whole run is over and how it ends, with a supervisor that only pretends."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Self

import pytest

from prism_edge.config import Config
from prism_edge.errors import ModelError
from prism_edge.supervisor import supervise as module
from prism_edge.supervisor.supervise import supervise
from prism_edge.supervisor.watch import StartRefusedError

LOOKS = 5  # how often a run looks whether it is over, at most


class Pretended:
    """A run whose processes are ready and whose recording has ended."""

    ready_s, status, alive, stop_s, ended = 1.0, "ready", True, 2.0, True

    def __init__(self, log: list[str], refusal: Exception | None) -> None:
        self._log, self._refusal = log, refusal

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._log.append("stopped")

    def run(self, finished: Callable[[], bool]) -> None:
        if self._refusal is not None:
            raise self._refusal
        self._log.append("over" if any(finished() for _ in range(LOOKS)) else "goes on")

    def reload(self, config: Config) -> None:
        self._log.append(f"reload {config.robot}")

    def ended_well(self) -> None:
        self._log.append("ended well")


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the run did, and what the service manager was told."""
    log: list[str] = []
    notifier = SimpleNamespace(
        starting=lambda seconds: None,
        ready=lambda: log.append("READY"),
        reloading=lambda: log.append("RELOADING"),
        status=lambda text: None,
        feed=lambda now_s: None,
        stopping=lambda seconds: log.append(f"STOPPING {seconds:g}"),
        send_what_waits=lambda: log.append("sent"),
    )
    monkeypatch.setattr(module, "Notifier", lambda: notifier)
    return log


@pytest.fixture
def signals(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Events that a signal sets, so to say."""
    signals = SimpleNamespace(stopped=threading.Event(), reload_wanted=threading.Event(), listen=lambda: None)
    monkeypatch.setattr(module, "StopSignals", lambda reload: signals)
    return signals


def pretend(monkeypatch: pytest.MonkeyPatch, log: list[str], refusal: Exception | None = None) -> None:
    monkeypatch.setattr(module, "Supervisor", lambda *_: Pretended(log, refusal))


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize(("stay", "then"), [(False, "over"), (True, "goes on")])
def test_a_run_ends_with_its_recording_unless_it_is_to_stay(
    stay: bool, then: str, log: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend(monkeypatch, log)
    assert supervise(Config(), stay=stay) == 0
    assert log == ["READY", then, "ended well", "STOPPING 7", "stopped", "sent"]


def test_a_signal_ends_a_run_that_is_to_stay(
    signals: Any, log: list[str], monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    signals.stopped.set()
    pretend(monkeypatch, log)
    caplog.set_level("INFO")
    assert supervise(Config()) == 0
    assert log == ["READY", "over", "ended well", "STOPPING 7", "stopped", "sent"]
    assert "stopping" in caplog.messages


@pytest.mark.usefixtures("signals")
def test_a_refused_start_gives_the_worker_s_code_and_has_not_ended_well(
    log: list[str], monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    """Its journal is kept."""
    pretend(monkeypatch, log, StartRefusedError("depth", ModelError.exit_code))
    assert supervise(Config()) == ModelError.exit_code
    assert log == ["STOPPING 7", "stopped", "sent"]
    assert caplog.messages == ["depth can't start (exit code 5); stopped"]


@pytest.mark.parametrize(
    ("ready_s", "heard"), [(1.0, ["READY", "RELOADING", "reload other", "READY"]), (None, ["reload other"])]
)
def test_a_reload_while_it_starts_makes_nothing_ready(
    ready_s: float | None, heard: list[str], signals: Any, log: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Pretended, "ready_s", ready_s)
    signals.reload_wanted.set()
    pretend(monkeypatch, log)
    assert supervise(Config(), reread=lambda: Config(robot="other")) == 0
    assert log[: log.index("goes on")] == heard
