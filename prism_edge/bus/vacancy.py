"""Endpoints of this host that are free to be listened on, asked without Zenoh (which starts threads)."""

from __future__ import annotations

import errno
import os
import socket
from pathlib import Path

from prism_edge.bus.keys import address_of, protocol_of
from prism_edge.errors import BusError


def can_listen(endpoint: str) -> bool:
    """Whether nobody listens on a TCP or Unix socket endpoint now; False where that can't be told."""
    protocol, _, address = endpoint.partition("/")
    try:
        if protocol == "unixsock-stream":
            return _path_is_free(address)
        host, _, port = address.rpartition(":")
        return protocol == "tcp" and port.isdigit() and _port_is_free(host, int(port))
    except (OSError, OverflowError, TypeError):  # a number that is no port, a name that is no host's
        return False


def check_vacant(endpoint: str) -> None:
    """Raises BusError where somebody surely listens on an endpoint now; of UDP's (quic) nothing is asked.

    Who asks before a daemon starts there takes no other one's words for that daemon's.
    """
    protocol, address = protocol_of(endpoint), address_of(endpoint)
    host, _, port = address.rpartition(":")
    taken = False
    try:
        if protocol == "unixsock-stream":
            with socket.socket(socket.AF_UNIX) as probe:
                taken = probe.connect_ex(address) == 0
        elif protocol in ("tcp", "tls", "ws") and port.isdigit():
            _port_is_free(host, int(port))
    except (OverflowError, TypeError):  # a number that is no port, a name that is no host's
        return
    except OSError as error:
        taken = error.errno == errno.EADDRINUSE
    if taken:
        raise BusError(f"bus.endpoint: {in_use(endpoint)}")


def in_use(endpoint: str) -> str:
    """What is said of an endpoint that somebody listens on."""
    return f"{endpoint} is in use already; is another prism-edge running?"


def free_endpoint() -> str:
    """A TCP endpoint on loopback that nobody listens on now. Raises OSError where no port is left."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _port_is_free(host: str, port: int) -> bool:
    family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # what waits to time out owns nothing
        probe.bind((host.strip("[]"), port))
    return True


def _path_is_free(path: str) -> bool:
    """A socket that nobody answers at was left by a process that was killed; Zenoh takes it over."""
    if not os.access(Path(path).parent, os.W_OK | os.X_OK):
        return False
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(path)
        except (FileNotFoundError, ConnectionRefusedError):
            return True
    return False
