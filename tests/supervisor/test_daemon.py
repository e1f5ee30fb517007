"""The daemon as a process of its own: signals to it, its death, and who started it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from prism_edge.config import Config
from prism_edge.config_file import dump
from prism_edge.supervisor.run_directory import PREFIX
from tests.supervisor.whole_runs import DEADLINE_S, assert_port_free, running
from tests.waiting import until

DAEMON = Path(__file__).with_name("fake_daemon.py")


@pytest.fixture
def daemon(config: Config, tmp_path: Path) -> Iterator[Callable[..., tuple[Any, dict[str, int]]]]:
    """Starts fake_daemon.py as a process of its own and waits until it is ready."""
    started: list[subprocess.Popen[str]] = []

    def start(*behaviours: str, before: Sequence[str] = ()) -> tuple[Any, dict[str, int]]:
        file = tmp_path / "given.yaml"
        file.write_text(dump(config))
        command = [sys.executable, str(DAEMON), str(file), *behaviours]
        process = subprocess.Popen([*before, *command], stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout is not None
        word, *pairs = process.stdout.readline().split()
        assert word == "ready"
        return process, {name: int(pid) for name, _, pid in (pair.partition("=") for pair in pairs)}

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.usefixtures("left_behind")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_ends_everything(daemon: Any, number: signal.Signals) -> None:
    process, pids = daemon("source:steady", "tracker:steady", "depth:steady")
    process.send_signal(number)
    assert process.wait(DEADLINE_S) == 0
    assert not any(running(pid) for pid in pids.values())


IGNORING = (
    "import os, signal, sys;"
    "signal.signal(signal.SIGCHLD, signal.SIG_IGN);"
    "os.execv(sys.argv[1], sys.argv[1:])"
)


@pytest.mark.usefixtures("left_behind")
def test_a_death_is_noticed_though_whoever_started_us_ignores_such(daemon: Any, tmp_path: Path) -> None:
    note = tmp_path / "note"
    process, pids = daemon(f"source:waits={note}", before=[sys.executable, "-c", IGNORING])
    note.unlink()
    os.kill(pids["source"], signal.SIGKILL)
    until(lambda: note.exists() or process.poll() is not None)  # its next life has begun
    process.terminate()
    assert process.wait(DEADLINE_S) == 0


def test_kill_of_the_supervisor_leaves_no_orphan_and_the_next_start_clears_up(
    daemon: Any, config: Config, tmp_path: Path
) -> None:
    process, pids = daemon("source:steady", "tracker:stubborn")
    process.kill()
    process.wait(DEADLINE_S)
    until(lambda: not any(running(pid) for pid in pids.values()))
    assert_port_free(config)
    assert list(tmp_path.glob(PREFIX + "*"))
    process, _ = daemon("source:steady")
    process.terminate()
    assert process.wait(DEADLINE_S) == 0
    assert not list(tmp_path.glob("*" + PREFIX + "*"))
