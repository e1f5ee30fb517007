"""Sockets of processes that were killed go; those of the living stay."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from prism_edge.bus.leftovers import sweep
from prism_edge.bus.links import open_session
from prism_edge.config import BusConfig

JOIN = (
    "import sys\n"
    "from prism_edge.bus.links import open_session\n"
    "from prism_edge.config import BusConfig\n"
    "session = open_session(BusConfig(endpoint=sys.argv[1]), listen=False)\n"
    "print('joined', flush=True)\n"
    "sys.stdin.read()\n"
)


def gone() -> int:
    """The number of a process that has ended."""
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait(timeout=60)
    return ended.pid


def test_a_life_that_was_killed_leaves_nothing_once_the_next_begins(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/bus"
    joined = subprocess.Popen(
        [sys.executable, "-c", JOIN, endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert joined.stdout is not None
    assert joined.stdout.readline() == b"joined\n"
    own = {f"bus.{joined.pid}.0", f"bus.{joined.pid}.0.lock"}
    with open_session(BusConfig(endpoint=endpoint), listen=False):
        assert own < {path.name for path in tmp_path.iterdir()}, "it lives"
    joined.send_signal(signal.SIGKILL)
    joined.communicate(timeout=60)
    assert {path.name for path in tmp_path.iterdir()} == own
    with open_session(BusConfig(endpoint=endpoint), listen=False):
        assert not own & {path.name for path in tmp_path.iterdir()}


def test_only_what_nobody_holds_and_nobody_else_named_goes(tmp_path: Path) -> None:
    pid = gone()
    held, free = tmp_path / f"bus.{pid}.0.lock", tmp_path / f"bus.{pid}.1.lock"
    others = [tmp_path / name for name in ("bus", "bus.lock", f"bus.{pid}.txt", f"bus2.{pid}.0.lock")]
    alive = tmp_path / f"bus.{os.getpid()}.7.lock"
    linked = tmp_path / f"bus.{pid}.2.lock"
    linked.symlink_to(others[0])
    for path in (held, free, alive, *others):
        path.touch()
    with held.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        sweep(str(tmp_path / "bus"))
    assert set(tmp_path.iterdir()) == {held, alive, linked, *others}
    sweep(str(tmp_path / "nowhere" / "bus"))  # harmless


def test_another_users_processes_live(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of them the system says no more than that they are none of ours."""

    def forbidden(pid: int, number: int) -> None:
        raise PermissionError

    theirs = tmp_path / "bus.1.0.lock"
    theirs.touch()
    monkeypatch.setattr(os, "kill", forbidden)
    sweep(str(tmp_path / "bus"))
    assert theirs.exists()
