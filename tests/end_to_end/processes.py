"""Starting the command line as a user does, looking at its processes, and listening to what it says."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import uuid
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import psutil

from prism_edge.bus.session import Bus
from prism_edge.bus.vacancy import free_endpoint
from prism_edge.config import BusConfig, Config
from tests.waiting import until

CHECKOUT = Path(__file__).resolve().parents[2]
CLI = (sys.executable, "-m", "prism_edge.cli")
DEADLINE_S = 30.0
MARK = "PRISM_EDGE_TEST"


def prism_edge(*arguments: str | Path, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    """Runs the command line to its end; fails where it has left a process behind."""
    mark = uuid.uuid4().hex
    done = subprocess.run(
        [*CLI, *map(str, arguments)],
        cwd=CHECKOUT,
        env={**os.environ, MARK: mark},
        capture_output=True,
        text=True,
        timeout=timeout_s,
    )
    left = [process for process in psutil.process_iter() if marked(process, mark)]
    assert not psutil.wait_procs(left, timeout=DEADLINE_S)[1], "processes were left running"
    return done


def marked(process: psutil.Process, mark: str) -> bool:
    """Whether a process was started, through any number of others, with this mark in its environment."""
    try:
        return process.environ().get(MARK) == mark
    except psutil.Error:
        return False


class Daemon:
    """``prism-edge run`` with an endpoint of its own."""

    def __init__(self, log: Path, *arguments: str | Path) -> None:
        self.config = replace(Config(), bus=BusConfig(free_endpoint(), retry_ms=50))
        self._log = log
        line = [*CLI, "run", *map(str, arguments), "--endpoint", self.config.bus.endpoint]
        with log.open("wb") as output:
            self._popen = subprocess.Popen(
                line, cwd=CHECKOUT, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT
            )
        self.family: list[psutil.Process] = []

    @property
    def log(self) -> str:
        return self._log.read_text()

    def until_ready(self) -> Self:
        """Returns once every process is ready; remembers them."""
        until(lambda: "ready after" in self.log or self._popen.poll() is not None, "ready")
        assert self._popen.poll() is None, self.log
        root = psutil.Process(self._popen.pid)
        self.family = [root, *root.children(recursive=True)]
        return self

    def send(self, number: signal.Signals) -> None:
        """A signal to the supervisor alone, as Ctrl-C reaches it: workers lead sessions of their own."""
        os.kill(self._popen.pid, number)

    def wait(self, timeout_s: float = DEADLINE_S) -> int:
        """The exit code."""
        return self._popen.wait(timeout_s)

    def leftovers(self, within_s: float) -> list[psutil.Process]:
        """Processes of the run that still live after ``within_s``."""
        self._popen.poll()
        return psutil.wait_procs(self.family, timeout=within_s)[1]

    def bus(self) -> Bus:
        """A subscriber's session."""
        return Bus.open(self.config, "test")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(psutil.Error):
            root = psutil.Process(self._popen.pid)
            self.family += [root, *root.children(recursive=True)]
        for process in self.family:
            with contextlib.suppress(psutil.Error):
                process.kill()
        self._popen.wait()


def port_is_free(endpoint: str) -> bool:
    """Whether a daemon could listen there."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, int(port)))
        except OSError:
            return False
    return True


def rows(message: Any) -> dict[str, dict[str, str]]:
    """`health` or `status` as values by name; ``level`` and ``message`` among them."""
    return {
        status.name: {"level": str(status.level), "message": status.message}
        | {pair.key: pair.value for pair in status.values}
        for status in message.status
    }
