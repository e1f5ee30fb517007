"""Starting and ending one process with all that it started."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from prism_edge.supervisor.child import Child, describe_exit
from tests.waiting import until

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


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in ("Z", "X")
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.fixture
def start() -> Iterator[Callable[..., Child]]:
    children = []

    def start(*arguments: str) -> Child:
        children.append(Child.spawn([sys.executable, "-c", *arguments]))
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


def test_one_that_a_driver_holds_is_not_waited_for(
    start: Callable[..., Child], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In uninterruptible sleep nothing ends a process; all others still want looking after."""
    child = start(SLEEP)
    with monkeypatch.context() as held:
        held.setattr(os, "killpg", lambda pid, number: None)
        child.kill()
        assert child.exit_code is None
        assert running(child.pid)
    child.kill()  # as the driver lets go
    assert child.poll() == -signal.SIGKILL


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
        "Child.spawn([sys.executable, '-c', sys.argv[1], str(os.getpid()), sys.argv[2]]); time.sleep(60)"
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


def forking(*lines: str, error: str = "") -> str:
    """What a process prints that has one thread, as the supervisor when it starts; pytest may have more."""
    script = ("import os, signal, sys, time", "from prism_edge.supervisor.child import Child", *lines)
    command = [sys.executable, "-c", "\n".join(script)]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run(
        command, input="ours", capture_output=True, text=True, timeout=60, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert error in done.stderr
    return done.stdout


WAIT = "while child.poll() is None: time.sleep(0.01)"


def test_a_fork_ends_with_what_its_body_returns() -> None:
    assert forking("child = Child.fork(lambda: 5)", WAIT, "print(child.exit_code)") == "5\n"


@pytest.mark.parametrize("error", ["ValueError('oh')", "SystemExit('oh')", "KeyboardInterrupt('oh')"])
def test_an_exception_ends_only_the_fork(error: str) -> None:
    body = f"def body(): raise {error}"
    assert forking(body, "child = Child.fork(body)", WAIT, "print(child.exit_code)", error="oh") == "1\n"


def test_what_waits_to_be_written_is_written_once() -> None:
    body = "def body(): print('in it'); return 0"
    said = forking(body, "print('before')", "child = Child.fork(body)", WAIT, "print('after')")
    assert said == "before\nin it\nafter\n"


def test_a_fork_clears_up_nothing_that_is_its_parents() -> None:
    at_exit = "import atexit; atexit.register(print, 'cleared')"
    said = forking(at_exit, "child = Child.fork(lambda: 0)", WAIT, "print('end')")
    assert said == "end\ncleared\n"


def test_a_fork_leads_a_group_and_reads_nothing() -> None:
    body = "def body(): return 7 if os.getpgid(0) == os.getpid() and sys.stdin.read() == '' else 8"
    lines = (body, "child = Child.fork(body)", "group = os.getpgid(child.pid)", WAIT)
    assert forking(*lines, "print(child.exit_code, group == child.pid)") == "7 True\n"


@pytest.mark.parametrize(("number", "code"), [("SIGTERM", -15), ("SIGINT", -2), ("SIGHUP", -1)])
def test_a_signal_to_a_fork_is_none_to_its_parent(number: str, code: int) -> None:
    """The parent has taken signals over; its copy has not, until it does so itself."""
    said = forking(
        "from prism_edge.workers.stopping import StopSignals",
        "signals = StopSignals(reload=True); child = Child.fork(lambda: time.sleep(60) or 0)",
        f"os.kill(child.pid, signal.{number})",
        WAIT,
        "signals.listen(); told = signals.stopped.wait(0.2) or signals.reload_wanted.is_set()",
        "print(child.exit_code, told)",
    )
    assert said == f"{code} False\n"


def test_what_a_fork_started_ends_with_it(tmp_path: Path) -> None:
    note = tmp_path / "pid"
    said = forking(
        "import subprocess",
        f"def body(): exec({WITH_GRANDCHILD!r}, {{}}); return 0",
        f"sys.argv = ['', {str(note)!r}, '60']; child = Child.fork(body)",
        f"while not os.path.exists({str(note)!r}): time.sleep(0.01)",
        "child.kill(); print(child.exit_code)",
    )
    assert said == "-9\n"
    grandchild = int(note.read_text())
    until(lambda: not running(grandchild))


def test_no_such_program_is_an_error() -> None:
    with pytest.raises(FileNotFoundError):
        Child.spawn(["/no/such/program"])
