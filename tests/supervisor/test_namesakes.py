"""Two processes of one name, told apart by their heartbeats."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace

import pytest

from prism_edge.bus.session import Bus
from prism_edge.config import Config
from prism_edge.messages import Heartbeat
from prism_edge.supervisor import namesakes as module
from prism_edge.supervisor.health import ERROR
from prism_edge.supervisor.namesakes import GONE_S, SURE_S, Namesakes
from prism_edge.supervisor.supervisor import Supervisor
from tests.supervisor.fake_daemon import cast
from tests.supervisor.test_liveness import beat
from tests.supervisor.whole_runs import in_time

LONG_S = 2 * SURE_S


def heartbeat(pid: int, clock_s: float) -> Heartbeat:
    return replace(beat("idle"), pid=pid, monotonic_ns=int(1e9 * clock_s))


def told(beats: Iterable[tuple[float, int, float]], now_s: float = LONG_S) -> list[str]:
    """What is there after (time, pid, its clock) in turn, seconds."""
    namesakes = Namesakes()
    for at_s, pid, clock_s in beats:
        namesakes.heard(heartbeat(pid, clock_s), at_s)
    return namesakes.there(now_s)


NAME = beat("idle").process
SECONDS = range(int(LONG_S))


def test_one_alone_is_none() -> None:
    assert not told((t, 7, t) for t in SECONDS)


def test_one_that_dies_every_second_is_none() -> None:
    assert not told((t, 100 + t, t) for t in SECONDS)


def test_one_whose_computer_began_anew_is_none() -> None:
    assert not told([(t, 7, 1000 + t) for t in range(5)] + [(t, 7, t) for t in range(10, int(LONG_S))])


def test_two_are_heard_by_turns() -> None:
    both = [(t, pid, t) for t in SECONDS for pid in (7, 8)]
    assert told(both) == [NAME]
    assert not told(both, LONG_S + GONE_S)  # one of them has gone
    assert not told(both[: int(SURE_S)], SURE_S / 2)  # too early


def test_once_it_is_sure_of_one_all_are_told() -> None:
    """Of another daemon each process is heard: the log's one line is not to be of one alone."""
    namesakes = Namesakes()
    for t in range(int(LONG_S)):
        for pid in (7, 8):
            for name, since in (("tracker", 0), ("depth", 3), ("scale", int(LONG_S))):
                if t >= since:
                    namesakes.heard(replace(heartbeat(pid, t), process=name), t)
        if there := namesakes.there(t):
            assert there == ["tracker", "depth"]
            return
    raise AssertionError("never told")


def test_two_of_one_pid_have_clocks_of_their_own() -> None:
    assert told((t, 7, t + ahead) for t in SECONDS for ahead in (0, 1000)) == [NAME]


@pytest.mark.usefixtures("left_behind", "slow_is_not_silent")
def test_a_running_daemon_says_so(
    config: Config, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SURE_S", 0.2)
    processes = cast(["tracker:steady", "depth:steady"])
    with Supervisor(config, *processes) as run, Bus.open(config, "test") as bus:
        run.run(in_time(lambda: run.ready))
        health, pids = bus.queue("health"), itertools.cycle((1, 2, 3))

        def said() -> object:
            for process in ("watch", "tracker"):  # of those who watch there may be many
                bus.publish("heartbeat", replace(heartbeat(next(pids), 1.0), process=process))
            return [
                status.message
                for message in health.drain()
                for status in message.status
                if status.name == "robot" and int(status.level) == ERROR
            ]

        run.run(in_time(said))
    assert caplog.text.count("name 'fake' is another's, too: tracker heard from two at once") == 1
