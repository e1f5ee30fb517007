"""How workers start: by forking where that gives a whole process, by a command line elsewhere."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from prism_edge.bus.vacancy import free_endpoint
from prism_edge.config import BusConfig, Config, DepthConfig, SourceConfig
from prism_edge.config_file import dump
from prism_edge.processes import PROCESSES
from prism_edge.supervisor.child import Child
from prism_edge.supervisor.start import can_fork, spawn_worker
from tests.sources.tiny_datasets import write_tum
from tests.waiting import until

CHECKOUT = Path(__file__).resolve().parents[2]


def test_a_process_with_another_thread_does_not_fork() -> None:
    release = threading.Event()
    other = threading.Thread(target=release.wait)
    other.start()
    try:
        assert not can_fork()
    finally:
        release.set()
        other.join()


def test_where_no_descriptor_is_left_to_look_with_it_does_not_fork(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error there would count as a death of the worker that is to start."""
    def full(folder: Path) -> Iterator[Path]:
        raise OSError(errno.EMFILE, "Too many open files", str(folder))

    monkeypatch.setattr(Path, "iterdir", full)
    assert not can_fork()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux says how many threads there are")
def test_what_workers_share_starts_no_thread() -> None:
    """Else none of them would be a fork, and each would load it for itself."""
    script = (
        "import importlib; from prism_edge.supervisor.start import SHARED, can_fork\n"
        "assert can_fork()\n"
        "for module in SHARED: importlib.import_module(module)\n"
        "assert can_fork()\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere no worker is a fork")
@pytest.mark.parametrize(
    ("command", "by_socket"),
    [
        (["prism_edge.supervisor"], False),
        (["prism_edge.supervisor"], True),
        (["prism_edge.cli", "run", "--stay"], False),
    ],
)
def test_first_lives_are_forks_and_later_ones_are_not(
    tmp_path: Path, command: list[str], by_socket: bool
) -> None:
    (tmp_path / "tum").mkdir()
    config = Config(
        bus=BusConfig(f"unixsock-stream/{tmp_path}/bus" if by_socket else free_endpoint()),
        source=SourceConfig(str(write_tum(tmp_path / "tum"))),
        depth=DepthConfig(model=""),
    )
    file = tmp_path / "config.yaml"
    file.write_text(dump(config))
    log = tmp_path / "log"
    inherited = {name: value for name, value in os.environ.items() if "THREADS" not in name}
    environment = inherited | {"XDG_RUNTIME_DIR": str(tmp_path), "PRISM_MARK": "of this test"}
    with log.open("w") as stderr:
        line = [sys.executable, "-m", *command, "--config", str(file)]
        daemon = subprocess.Popen(line, stderr=stderr, env=environment, cwd=CHECKOUT)
    try:
        until(lambda: "ready after" in log.read_text(), deadline_s=60.0)
        root = psutil.Process(daemon.pid)
        first = {worker.cmdline()[0]: worker for worker in root.children()}
        assert first.keys() == {f"prism-edge {name}" for name in ("source", "tracker", "scale", "backend")}
        assert all(is_a_copy_of(root, worker) for worker in first.values())
        assert all(worker.environ()["PRISM_MARK"] == "of this test" for worker in first.values())
        first["prism-edge tracker"].kill()
        until(lambda: log.read_text().count("tracker started again"), deadline_s=60.0)
        until(lambda: len(titled(root, "prism-edge tracker")) == 1, deadline_s=60.0)
        [later] = titled(root, "prism-edge tracker")
        assert later.pid != first["prism-edge tracker"].pid
        assert not is_a_copy_of(root, later)
    finally:
        daemon.terminate()
        assert daemon.wait(30) == 0
    assert not any(psutil.pid_exists(worker.pid) for worker in first.values())


def later_life(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The command line by which a worker is started again."""
    lines: list[list[str]] = []
    monkeypatch.setattr(Child, "spawn", lines.append)
    spawn_worker(PROCESSES["tracker"], Path("config.yaml"), 1)
    return lines[0]


def is_this_package(line: list[str], folder: Path, path: Path) -> None:
    """The command line is answered by this package: run in a folder, with ``path`` for Python to look in."""
    environment = {**os.environ, "PYTHONPATH": str(path)}
    asked = subprocess.run([*line, "--help"], cwd=folder, env=environment, capture_output=True, text=True)
    assert asked.returncode == 0, asked.stderr
    assert "--parent PID" in asked.stdout


def test_a_later_life_is_this_package_whatever_lies_in_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("prism_edge.py", "numpy.py"):
        (tmp_path / name).write_text("raise SystemExit('the folder is asked')\n")
    is_this_package(later_life(monkeypatch), tmp_path, CHECKOUT)


def test_a_later_life_is_the_package_that_runs_wherever_that_was_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As by `python -m prism_edge` in a checkout: no path of a new interpreter leads there."""
    (tmp_path / "prism_edge").mkdir()
    (tmp_path / "prism_edge/__init__.py").write_text("raise SystemExit('another is asked')\n")
    is_this_package(later_life(monkeypatch), CHECKOUT, tmp_path)


def titled(root: psutil.Process, title: str) -> list[psutil.Process]:
    return [worker for worker in root.children() if worker.cmdline()[:1] == [title]]


def is_a_copy_of(root: psutil.Process, worker: psutil.Process) -> bool:
    """Whether its program lies at the same addresses: they are drawn anew for whatever is loaded anew."""
    return addresses(root.pid) == addresses(worker.pid)


def addresses(pid: int) -> set[str]:
    maps = Path(f"/proc/{pid}/maps").read_text().splitlines()
    return {line.split()[0] for line in maps if "zenoh" in line}
