"""Who is ready: tokens that come and go, and waits for them, on a session whose tokens the tests make."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from prism_edge.bus.presence import Presence
from prism_edge.bus.session import Bus
from prism_edge.config import Config
from tests.bus.tokens import Session


@pytest.fixture
def session() -> Session:
    return Session("prism/robot/internal/ready")


@pytest.fixture
def stopped() -> threading.Event:
    return threading.Event()


@pytest.fixture
def presence(session: Session, stopped: threading.Event) -> Iterator[Presence]:
    present = Presence(session, "robot", stopped)
    yield present
    present.close()
    assert not any(thread.name == "presence" and thread.is_alive() for thread in threading.enumerate())


def test_a_wait_ends_when_all_are_there(session: Session, presence: Presence) -> None:
    assert presence.missing(set(), 0.0) == set()
    session.says("source", True)
    assert presence.missing({"source"}, 30.0) == set()
    assert presence.missing({"source", "depth"}, 0.05) == {"depth"}
    found: list[set[str]] = []
    waiting = threading.Thread(target=lambda: found.append(presence.missing({"source", "depth"}, 60.0)))
    waiting.start()
    session.says("depth", True)
    waiting.join(30.0)
    assert found == [set()]


def test_who_goes_is_missing_until_a_successor_comes(session: Session, presence: Presence) -> None:
    for ready in (True, False):
        session.says("source", ready)
    session.says("depth", True)  # once it is seen, so was all before it
    assert presence.missing({"depth"}, 30.0) == set()
    assert presence.missing({"source"}, 0.0) == {"source"}
    session.says("source", True)
    assert presence.missing({"source"}, 30.0) == set()
    assert session.subscriptions == 1


def test_a_stop_ends_a_wait(presence: Presence, stopped: threading.Event) -> None:
    threading.Timer(0.05, stopped.set).start()
    began = time.monotonic()
    assert presence.missing({"source"}, 60.0) == {"source"}
    assert time.monotonic() - began < 30.0


def test_all_questions_of_a_bus_share_one_subscription(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With one for each a killed process can stay ready for good."""
    made = []

    def make(*arguments: Any) -> Presence:
        made.append(Presence(*arguments))
        return made[-1]

    monkeypatch.setattr("prism_edge.bus.session.Presence", make)
    with Bus.open(config, "supervisor", listen=True) as bus:
        for _ in range(3):
            assert bus.await_ready(["source"], 0.0) == {"source"}
        assert len(made) == 1
    assert bus.await_ready(["source"], 0.0) == {"source"}
