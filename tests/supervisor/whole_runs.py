"""What tests of whole runs share: deadlines, and seeing what is left."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from pathlib import Path

from prism_edge.config import Config

DEADLINE_S = 30.0


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in ("Z", "X")
    except (FileNotFoundError, ProcessLookupError):
        return False


def in_time(condition: Callable[[], object]) -> Callable[[], bool]:
    """The condition, for ``Supervisor.run``; fails the test after the deadline."""
    end = time.monotonic() + DEADLINE_S

    def check() -> bool:
        assert time.monotonic() < end, "waited in vain"
        return bool(condition())

    return check


def assert_port_free(config: Config) -> None:
    host, port = config.bus.endpoint.removeprefix("tcp/").split(":")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # what waits to time out owns nothing
        probe.bind((host, int(port)))
