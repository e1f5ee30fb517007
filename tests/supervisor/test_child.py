"""Starting and ending one process with all that it started."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from prism_edge.supervisor.child import Child, describe_exit

SLEEP = "import time; time.sleep(60)"
# Starts a process of its own, says which, and then ends or waits.
WITH_GRANDCHILD = (
    "import pathlib, subprocess, sys, time\n"
    "p = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
    "new = pathlib.Path(sys.argv[1] + '.new')\n"
    "new.write_text(str(p.pid))\n"
    "new.rename(sys.argv[1])\n"
    "time.sleep(float(sys.argv[2]))\n"
)


def until(condition: Callable[[], object], deadline_s: float = 20.0) -> None:
    end = time.monotonic() + deadline_s
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in ("Z", "X")
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.fixture
def start() -> Iterator[Callable[..., Child]]:
    children = []

    def start(*arguments: str) -> Child:
        children.append(Child([sys.executable, "-c", *arguments]))
        return children[-1]

    yield start
    for child in children:
        child.kill()


def test_exit_code_is_kept(start: Callable[..., Child]) -> None:
    child = start("raise SystemExit(5)")
    until(lambda: child.poll() is not None)
    assert child.poll() == 5
    child.terminate()
    child.kill()
    assert child.exit_code == 5


def test_terminate_ends_it_by_its_signal(start: Callable[..., Child]) -> None:
    child = start(SLEEP)
    child.terminate()
    until(lambda: child.poll() is not None)
    assert child.exit_code == -15


@pytest.mark.parametrize("ends_itself", [True, False])
def test_what_it_started_ends_with_it(start: Callable[..., Child], tmp_path: Path, ends_itself: bool) -> None:
    note = tmp_path / "pid"
    child = start(WITH_GRANDCHILD, str(note), "0" if ends_itself else "60")
    until(note.exists)
    grandchild = int(note.read_text())
    if ends_itself:
        until(lambda: child.poll() is not None)
    else:
        child.kill()
    until(lambda: not running(grandchild))


def test_leads_a_group_of_its_own_in_the_same_session(start: Callable[..., Child]) -> None:
    """In sessions of their own Linux would weigh workers alike, however nice they are."""
    child = start(SLEEP)
    assert os.getpgid(child.pid) == child.pid != os.getpgid(0)
    assert os.getsid(child.pid) == os.getsid(0)


def test_worker_dies_with_the_parent_that_started_it(tmp_path: Path) -> None:
    note = tmp_path / "pid"
    worker = (
        "import os, pathlib, sys, time; from prism_edge.workers.stopping import die_with;"
        "die_with(int(sys.argv[1]));"
        "note = pathlib.Path(sys.argv[2]); new = note.with_suffix('.new'); new.write_text(str(os.getpid()));"
        "new.rename(note); time.sleep(60)"
    )
    parent = (
        "import os, sys, time; from prism_edge.supervisor.child import Child;"
        "Child([sys.executable, '-c', sys.argv[1], str(os.getpid()), sys.argv[2]]); time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", parent, worker, str(note)])
    until(note.exists)
    orphan = int(note.read_text())
    assert running(orphan)
    process.kill()
    process.wait()
    until(lambda: not running(orphan))


def test_worker_whose_parent_is_gone_already_ends_at_once() -> None:
    script = "from prism_edge.workers.stopping import die_with; die_with(1 << 22)"
    assert subprocess.run([sys.executable, "-c", script]).returncode == 128 + 9


@pytest.mark.parametrize(
    ("code", "words"), [(0, "exit code 0"), (-9, "killed by SIGKILL"), (-200, "killed by signal 200")]
)
def test_exit_in_words(code: int, words: str) -> None:
    assert describe_exit(code) == words
