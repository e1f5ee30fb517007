"""What systemd is told of the run: readiness, a status line, food for its watchdog (sd_notify)."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections import deque
from collections.abc import MutableMapping

log = logging.getLogger("prism_edge.supervisor")

_MOST_WAITING = 64  # messages; the oldest go
LONGEST_STATUS = 300  # characters: `systemctl status` shows one line


class Notifier:
    """Tells the service manager how the daemon is; does nothing where nobody asked to be told.

    The protocol is a datagram of ``KEY=value`` lines to the socket named by ``NOTIFY_SOCKET`` (a path, or
    ``@name`` in Linux's abstract namespace). Losing one is no reason to stop: errors are logged once. What a
    manager that is slow has no room for (Linux: ten messages) is sent again with the next call, in order.
    """

    def __init__(self, environment: MutableMapping[str, str] | None = None) -> None:
        """Takes the manager's variables out of ``environment``: the workers are not to speak for us."""
        given = os.environ if environment is None else environment
        address = given.pop("NOTIFY_SOCKET", "")
        period_us, pid = given.pop("WATCHDOG_USEC", ""), given.pop("WATCHDOG_PID", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        if not address.startswith(("/", "@")):
            self._address = ""  # none, or of a kind (vsock) that only virtual machines have
        meant = pid in ("", str(os.getpid()))
        is_number = period_us.isascii() and period_us.isdigit() and len(period_us) < 19
        self.watchdog_s = int(period_us) / 1e6 if self._address and meant and is_number else 0.0
        self._fed_s = float("-inf")
        self._status = ""
        self._unsent: deque[str] = deque(maxlen=_MOST_WAITING)
        self._failed = False

    def starting(self, within_s: float) -> None:
        """It may take so long, where the manager (TimeoutStartSec) would give it less."""
        self._send(_longer(within_s))

    def ready(self) -> None:
        """Poses can flow; also the end of what :meth:`reloading` began."""
        self._send("READY=1")

    def reloading(self) -> None:
        """The configuration is being read again; :meth:`ready` follows."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self, within_s: float) -> None:
        """The end has begun, and may take so long, where the manager (TimeoutStopSec) would give it less."""
        self._send("STOPPING=1", _longer(within_s))

    def status(self, text: str) -> None:
        """One line for ``systemctl status``; sent only when it has changed. Call it often."""
        self.send_what_waits()
        line = " ".join(text.split())[:LONGEST_STATUS]
        if line != self._status:
            self._status = line
            self._send(f"STATUS={line}")

    def feed(self, now_s: float) -> None:
        """Feed the watchdog, twice within its period; call it often, and only while all is well."""
        if self.watchdog_s and now_s - self._fed_s >= self.watchdog_s / 2:
            self.send_what_waits()
            if not self._unsent:  # else with one of the next calls: nothing else feeds it
                self._fed_s = now_s
                self._send("WATCHDOG=1")

    def _send(self, *lines: str) -> None:
        if self._address:
            if lines[0].startswith("STATUS="):  # of what waits only the newest is worth a look
                said = (message for message in self._unsent if not message.startswith("STATUS="))
                self._unsent = deque(said, _MOST_WAITING)
            self._unsent.append("\n".join(lines))
            self.send_what_waits()

    def send_what_waits(self) -> None:
        """Send again what the manager had no room for."""
        if not self._unsent:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
                sender.setblocking(False)  # a manager that hangs is not waited for
                while self._unsent:
                    sender.sendto(self._unsent[0].encode(), self._address)
                    self._unsent.popleft()
        except BlockingIOError:
            pass
        except OSError as error:
            self._unsent.clear()
            if not self._failed:
                self._failed = True
                log.warning("the service manager can't be told: %s", error.strerror or error)


def _longer(within_s: float) -> str:
    return f"EXTEND_TIMEOUT_USEC={round(within_s * 1e6)}"
