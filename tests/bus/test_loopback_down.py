"""Where loopback is down nobody would ever be heard, though listening on it works."""

from __future__ import annotations

import errno
import socket

import pytest

from prism_edge.bus.links import open_session
from prism_edge.config import Config
from prism_edge.errors import BusError


def test_it_is_said_at_once(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    class Down(socket.socket):
        def connect(self, address: object) -> None:
            raise OSError(errno.ENETUNREACH, "Network is unreachable")

    monkeypatch.setattr(socket, "socket", Down)
    with pytest.raises(BusError, match="is loopback up"):
        open_session(config.bus, listen=True)
