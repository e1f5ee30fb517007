"""However a run ends, nothing of it is left."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.end_to_end.processes import Daemon, port_is_free, prism_edge, wait_until


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_everything_within_three_seconds(
    number: signal.Signals, long_room: Path, camera: Path, network: Path, daemon: Callable[..., Daemon]
) -> None:
    running = daemon(long_room, "--camera", camera, "--model", network).until_ready()
    assert len(running.family) == 6  # or there is nothing to end
    started = time.monotonic()
    running.send(number)
    assert running.wait(3.0) == 0
    assert not running.leftovers(max(0.0, started + 3.0 - time.monotonic()))
    assert port_is_free(running.config.bus.endpoint)
    assert "Traceback" not in running.log


def test_a_killed_supervisor_takes_its_processes_along(
    long_room: Path, camera: Path, network: Path, daemon: Callable[..., Daemon]
) -> None:
    running = daemon(long_room, "--camera", camera, "--model", network).until_ready()
    assert len(running.family) == 6
    running.send(signal.SIGKILL)
    assert running.wait(3.0) == -signal.SIGKILL
    assert not running.leftovers(3.0)
    assert port_is_free(running.config.bus.endpoint)


def test_a_run_ends_with_its_recording(
    room: Path, camera: Path, network: Path, daemon: Callable[..., Daemon]
) -> None:
    running = daemon(room, "--camera", camera, "--model", network).until_ready()
    assert running.wait() == 0, running.log
    assert not running.leftovers(1.0)
    assert "the recording has ended: 60 frames" in running.log
    assert "Traceback" not in running.log
    assert "ERROR" not in running.log


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
        wait_until(lambda: poses.take(0.1), "poses of the first daemon")
    assert not [process for process in first.family if not process.is_running()]
