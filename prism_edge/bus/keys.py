"""Keys on the bus: ``prism/<robot>/<topic>``."""

from __future__ import annotations

import re

from prism_edge.errors import BusError, ConfigError
from prism_edge.topics import Command, Topic

# What Zenoh gives a meaning of its own inside a key: the separator, wildcards, parameters, fragments.
_SPECIAL = "/*$#?"
# Links that Zenoh knows and that carry messages of any size reliably.
_PROTOCOLS = ("tcp", "tls", "quic", "ws", "unixsock-stream")

# Bytes of a Unix socket's path: Linux's sun_path without its NUL. The processes listen beside the bus's own,
# at PATH.PID.N (links.py): the largest PID there is, and more sessions than one process opens.
_SOCKET_PATH = 108 - 1
_BESIDE = len(".4194304.9999")

_BY_TCP = ("tcp", "tls", "ws")
_LOOPBACK = re.compile(r"localhost|127(\.[0-9]{1,3}){3}|\[::1\]")


def check_robot_name(name: str) -> str:
    """The name, if it can stand as one chunk of a Zenoh key expression; else ConfigError."""
    problem = ""
    if not name:
        problem = "is empty"
    elif found := [c for c in _SPECIAL if c in name]:
        problem = f"contains {' '.join(found)}"
    elif name.startswith("@"):
        problem = "starts with @, which hides a key from wildcards"
    elif name != name.strip() or not name.isprintable():
        problem = "contains control characters, or spaces at its ends"
    if problem:
        raise ConfigError(f"robot: {name!r} {problem}; it becomes part of the keys prism/<robot>/...")
    return name


def key(robot: str, topic: Topic | Command, speaker: str = "*") -> str:
    """A topic's or command's key for this robot; where all say it, that of ``speaker`` alone, or of any."""
    own = f"/{speaker}" if isinstance(topic, Topic) and topic.of_all else ""
    return f"prism/{robot}/{topic.key}{own}"


def alive_key(robot: str, process: str) -> str:
    """The liveliness token that says that a process is there."""
    return f"prism/{robot}/alive/{process}"


def ready_key(robot: str, process: str) -> str:
    """The liveliness token that says that a process has declared all it listens to."""
    return f"prism/{robot}/internal/ready/{process}"


def run_key(robot: str, run: str) -> str:
    """The liveliness token that says which run of the robot's daemon this is; ``*`` for any."""
    return f"prism/{robot}/internal/run/{run}"


def protocol_of(endpoint: str) -> str:
    """What an endpoint begins with, such as ``tcp``."""
    return endpoint.partition("/")[0]


def address_of(endpoint: str) -> str:
    """What it listens on or connects to, such as ``HOST:PORT``, without settings behind it."""
    return re.split(r"[?#]", endpoint.partition("/")[2], maxsplit=1)[0]


def check_loopback(endpoint: str) -> str:
    """The listener's endpoint, if only this host can reach it; else ConfigError, or BusError if malformed."""
    check_endpoint(endpoint)
    host = endpoint.partition("/")[2].rpartition(":")[0]
    if protocol_of(endpoint) != "unixsock-stream" and not _LOOPBACK.fullmatch(host):
        raise ConfigError(
            f"bus.endpoint: {endpoint} is not of this host alone; network.endpoint opens the robot's network"
        )
    return endpoint


def collide(loopback: str, other: str) -> bool:
    """Whether a port can't be listened on for both: an endpoint on loopback, and any other."""
    if {protocol_of(loopback), protocol_of(other)} - set(_BY_TCP):
        return False
    (host, _, port), (other_host, _, other_port) = (address_of(e).rpartition(":") for e in (loopback, other))
    everywhere = ("[::]",) if host.startswith("[") else ("[::]", "0.0.0.0")
    return port == other_port and other_host in (host, *everywhere)


def check_endpoint(endpoint: str, setting: str = "bus.endpoint") -> str:
    """The endpoint, if Zenoh could listen on it or connect to it; else BusError.

    Without this, a mistyped endpoint would be retried for ever, and of a socket whose path leaves no room for
    those beside it each worker would fail by itself. ``setting``: whose it is, for the message; beside a
    ``network.endpoint`` there are none.
    """
    protocol, address = protocol_of(endpoint), address_of(endpoint)
    problem = ""
    if protocol not in _PROTOCOLS:
        problem = f"it must start with one of {', '.join(p + '/' for p in _PROTOCOLS)}"
    elif protocol != "unixsock-stream":
        host, colon, port = address.rpartition(":")
        if not (host and colon and re.fullmatch(r"[0-9]{1,5}", port) and 0 < int(port) < 65536):
            problem = "it needs HOST:PORT after the slash, with a port from 1 to 65535"
        elif not re.fullmatch(r"\[[0-9a-fA-F:.%\w]+\]|[\w.-]+", host):
            problem = f"{host!r} is no host name or address"
    elif not address:
        problem = "it needs a path after the slash"
    else:
        problem = _too_long(address, beside=setting == "bus.endpoint")
    if problem:
        raise BusError(f"{setting}: {endpoint!r} is no endpoint: {problem}")
    return endpoint


def _too_long(path: str, beside: bool) -> str:
    """What is wrong with the length of a socket's path, in bytes; empty where nothing is."""
    length = len(path.encode("utf-8", "surrogatepass"))
    most = _SOCKET_PATH - (_BESIDE if beside else 0)
    if length <= most:
        return ""
    why = f": a socket's has {_SOCKET_PATH}, and the processes' own are beside it, at PATH.PID.N"
    return f"its path has {length} bytes, and {most} are the most{why if beside else ' of a socket'}"
