"""A service manager's end of sd_notify: the socket that a daemon tells how it is."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from types import TracebackType


class Manager:
    """Listens at an address as ``NOTIFY_SOCKET`` has it: a path, or ``@name`` for an abstract one."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.heard: list[str] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self._socket.settimeout(0.05)

    def __enter__(self) -> Manager:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()

    def hear(self) -> list[str]:
        """All lines so far."""
        try:
            while data := self._socket.recv(8192):
                self.heard += data.decode().split("\n")
        except TimeoutError:
            pass
        return self.heard

    def until(self, condition: Callable[[list[str]], object], deadline_s: float = 30.0) -> None:
        """Wait until what was heard satisfies a condition."""
        end = time.monotonic() + deadline_s
        while not condition(self.hear()):
            assert time.monotonic() < end, f"waited in vain; heard {self.heard}"
