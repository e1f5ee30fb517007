"""Log lines to systemd's journal with their fields, by its native protocol."""

from __future__ import annotations

import logging
import os
import select
import socket
import struct
import sys
from collections.abc import Mapping

from prism_edge.errors import say

SOCKET = "/run/systemd/journal/socket"
IDENTIFIER = "prism-edge"
LONGEST = 16 * 1024  # bytes of a message; a datagram must fit into the socket's buffer

# syslog's levels
_PRIORITY = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}


class JournalHandler(logging.Handler):
    """Sends each record as one datagram of fields; what the journal does not take goes to stderr.

    A line that would have to wait there too is lost: no process is held up or ended for its log.
    """

    def __init__(self, fields: Mapping[str, str], path: str = SOCKET) -> None:
        """``fields`` go with every line, such as PRISM_PROCESS. Raises OSError where nobody listens."""
        super().__init__()
        self._fields, self._path = dict(fields), path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        try:
            self._socket.connect(path)
        except OSError:
            self._socket.close()
            raise
        self._socket.setblocking(False)  # a journal that hangs must not hold up the tracker

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record."""
        try:
            self._send(pack(record, self.format(record), self._fields))
        except OSError:
            if _stderr_takes_more():
                say(f"<{priority(record)}>{self.format(record)}")
        except Exception:  # what logging itself does with a record that can't be formatted
            self.handleError(record)

    def _send(self, datagram: bytes) -> None:
        try:
            self._socket.send(datagram)
        except BlockingIOError:  # it hangs
            raise
        except OSError:  # systemd makes its socket anew where that is restarted
            self._socket.connect(self._path)
            self._socket.send(datagram)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
        super().close()


def priority(record: logging.LogRecord) -> int:
    """The syslog level of a record."""
    return next((p for level, p in sorted(_PRIORITY.items(), reverse=True) if record.levelno >= level), 7)


def pack(record: logging.LogRecord, message: str, fields: Mapping[str, str]) -> bytes:
    """The datagram of a record: ``NAME=value`` lines; what has line breaks comes with its length instead."""
    all_fields = {
        "MESSAGE": message,
        "PRIORITY": str(priority(record)),
        "SYSLOG_IDENTIFIER": IDENTIFIER,
        "LOGGER": record.name,
        "CODE_FILE": record.pathname,
        "CODE_LINE": str(record.lineno),
        "CODE_FUNC": record.funcName,
        **fields,
    }
    parts = []
    for name, value in all_fields.items():
        data = value.encode("utf-8", "replace")[:LONGEST]
        if b"\n" in data:
            parts.append(name.encode() + b"\n" + struct.pack("<Q", len(data)) + data + b"\n")
        else:
            parts.append(name.encode() + b"=" + data + b"\n")
    return b"".join(parts)


def _stderr_takes_more() -> bool:
    """Whether a line can be written there now: mostly it is the journal's too, and hangs with it."""
    try:
        poll = select.poll()
        poll.register(sys.stderr.fileno(), select.POLLOUT)
        return any(event & select.POLLOUT for _, event in poll.poll(0))
    except (OSError, ValueError, AttributeError):  # no file: it waits for nobody
        return True


def stderr_is_the_journal() -> bool:
    """Whether stderr is connected to the journal: systemd says so by the stream's device and inode."""
    try:
        device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
        status = os.fstat(sys.stderr.fileno())
        return (int(device), int(inode)) == (status.st_dev, status.st_ino)
    except (ValueError, OSError):
        return False
