"""The daemon as a child: its words are passed on, and nothing of it stays behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from prism_edge.errors import EvaluationError
from prism_edge.evaluation.daemon import SUPERVISOR, Daemon, DaemonError, last_error
from tests.waiting import until

# Starts a child of its own, says both process ids, and ignores requests to end.
STUBBORN = """
import os, signal, subprocess, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
inner = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"], start_new_session=True)
print(os.getpid(), inner.pid, flush=True)
time.sleep(600)
"""


def alive(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.Error:
        return False


def daemon(tmp_path: Path, code: str, stop_s: float = 0.2) -> Daemon:
    return Daemon(tmp_path / "c.yaml", tmp_path / "log", stop_s, (sys.executable, "-c", code))


def test_a_daemon_that_refuses_is_quoted_with_its_exit_code(tmp_path: Path) -> None:
    code = (
        "import sys; print('starting', file=sys.stderr);"
        "print('prism-edge depth: error: no such model: x.onnx', file=sys.stderr);"
        "print('12:00:00 ERROR supervisor: stopped', file=sys.stderr); sys.exit(5)"
    )
    message = r"^no such model: x\.onnx$"
    with daemon(tmp_path, code) as one, pytest.raises(DaemonError, match=message) as caught:
        until(lambda: one.check())
    assert caught.value.exit_code == 5


def test_a_daemon_that_ends_without_a_word_is_an_error_too(tmp_path: Path) -> None:
    codes = {"": "ended by itself", "print('bye')": "^bye$", "import os; os.abort()": "ended by itself"}
    for code, message in codes.items():
        with daemon(tmp_path, code) as one, pytest.raises(DaemonError, match=message) as caught:
            until(lambda one=one: one.check())
        assert caught.value.exit_code == EvaluationError.exit_code


def test_nothing_is_left_of_a_daemon_that_will_not_end(tmp_path: Path) -> None:
    with daemon(tmp_path, STUBBORN) as one:
        one.check()
        until(lambda: len((tmp_path / "log").read_text().split()) == 2)
        pids = [int(word) for word in (tmp_path / "log").read_text().split()]
        assert all(alive(pid) for pid in pids)
        assert pids[0] == one.pid
    assert not any(alive(pid) for pid in pids)


def test_a_daemon_that_ends_when_asked_is_not_killed(tmp_path: Path) -> None:
    code = (
        "import signal, sys, time; signal.signal(signal.SIGTERM, lambda *_: (print('done'), sys.exit(0)));"
        "print('up', flush=True); time.sleep(600)"
    )
    with daemon(tmp_path, code, stop_s=20.0):
        until(lambda: "up" in (tmp_path / "log").read_text())
    assert (tmp_path / "log").read_text().split() == ["up", "done"]


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's signal at a parent's death is Linux's")
def test_an_evaluation_that_is_killed_takes_the_daemon_along(tmp_path: Path) -> None:
    code = f"""
import sys, time
from pathlib import Path
from prism_edge.evaluation.daemon import Daemon
folder = Path({str(tmp_path)!r})
one = Daemon(folder / "c", folder / "log", 1.0, (sys.executable, "-c", "import time; time.sleep(600)"))
print(one.pid, flush=True)
time.sleep(600)
"""
    root = Path(__file__).resolve().parents[2]
    evaluation = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=root)
    try:
        assert evaluation.stdout is not None
        pid = int(evaluation.stdout.readline())
        assert alive(pid)
    finally:
        os.kill(evaluation.pid, signal.SIGKILL)
        evaluation.communicate()
    until(lambda: not alive(pid))


def test_what_cannot_be_started_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="can't be started"):
        Daemon(tmp_path / "c", tmp_path / "absent" / "log", 1.0)
    with pytest.raises(EvaluationError, match="can't be started"):
        Daemon(tmp_path / "c", tmp_path / "log", 1.0, (str(tmp_path / "nobody"),))


def test_the_last_error_line_is_found_among_log_lines(tmp_path: Path) -> None:
    log = tmp_path / "log"
    assert last_error(log) == ""
    errors = b"prism-edge: error: first\nprism-edge source: error: second: x\n"
    log.write_bytes(b"\xff\xfe noise\n" + errors + b"INFO bye\n\n")
    assert last_error(log) == "second: x"


def test_the_daemon_is_this_package_whatever_lies_in_the_folder(tmp_path: Path) -> None:
    """A checkout, the folder above one, or anything that bears a library's name."""
    for name in ("prism_edge.py", "numpy.py"):
        (tmp_path / name).write_text("raise SystemExit('the folder is asked')\n")
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    asked = subprocess.run(
        [*SUPERVISOR, "--help"], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert asked.returncode == 0, asked.stderr
    assert "--config FILE" in asked.stdout
