"""However a run ends, nothing of it is left."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from prism_edge.bus.vacancy import free_endpoint
from tests.end_to_end.processes import DEADLINE_S, Daemon, port_is_free, prism_edge
from tests.waiting import until


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_everything_within_three_seconds(
    number: signal.Signals, long_room: Path, camera: Path, network: Path, daemon: Callable[..., Daemon]
) -> None:
    for _ in range(3):  # a busy machine may stand still meanwhile, if not each time
        running = daemon(long_room, "--camera", camera, "--model", network).until_ready()
        assert len(running.family) == 6  # or there is nothing to end
        started = time.monotonic()
        running.send(number)
        assert running.wait() == 0
        assert not running.leftovers(DEADLINE_S)
        taken_s = time.monotonic() - started
        assert port_is_free(running.config.bus.endpoint)
        assert "Traceback" not in running.log
        if taken_s <= 3.0:
            return
    pytest.fail(f"it took {taken_s:.1f} s, and more than 3 s each time")


def test_a_killed_supervisor_takes_its_processes_along(
    long_room: Path, camera: Path, network: Path, daemon: Callable[..., Daemon]
) -> None:
    running = daemon(long_room, "--camera", camera, "--model", network).until_ready()
    assert len(running.family) == 6
    running.send(signal.SIGKILL)
    assert running.wait() == -signal.SIGKILL
    assert not running.leftovers(DEADLINE_S)
    assert port_is_free(running.config.bus.endpoint)


def test_a_run_ends_with_its_recording(room: Path, camera: Path, network: Path) -> None:
    endpoint = free_endpoint()
    done = prism_edge("run", room, "--camera", camera, "--model", network, "--endpoint", endpoint)
    assert done.returncode == 0, done.stderr
    assert "ready after" in done.stderr
    assert "the recording has ended: 60 frames" in done.stderr
    assert "Traceback" not in done.stderr
    assert "ERROR" not in done.stderr


def test_a_second_daemon_on_the_same_endpoint_says_so_and_leaves_the_first_alone(
    long_room: Path, camera: Path, network: Path, daemon: Callable[..., Daemon]
) -> None:
    first = daemon(long_room, "--camera", camera, "--model", network).until_ready()
    endpoint = first.config.bus.endpoint
    second = prism_edge("run", long_room, "--camera", camera, "--model", network, "--endpoint", endpoint)
    assert second.returncode == 6
    assert "in use already" in second.stderr
    assert "Traceback" not in second.stderr
    with first.bus() as bus:
        poses = bus.queue("pose")
        until(lambda: poses.take(0.1), "poses of the first daemon")
    assert not [process for process in first.family if not process.is_running()]
