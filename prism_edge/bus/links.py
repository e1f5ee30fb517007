"""How processes reach each other: Zenoh's configuration, and each topic's quality of service."""

from __future__ import annotations

import itertools
import json
import os
import re
import socket
from typing import Any

import zenoh

from prism_edge.bus.access import SECURE, access_control, check_files, tls
from prism_edge.bus.keys import address_of, check_endpoint, protocol_of
from prism_edge.bus.leftovers import sweep
from prism_edge.bus.vacancy import in_use
from prism_edge.config import BusConfig, NetworkConfig
from prism_edge.errors import BusError, first_line
from prism_edge.topics import TOPICS, Topic

_DIRECT = "tcp/127.0.0.1:0"
_SOCKET = "unixsock-stream"
_sessions = itertools.count()
# How long a publisher waits, once, for a receiver that is megabytes behind, before it drops what is for it.
_PATIENCE_US = 50_000
_BATCHES = 16  # that wait to be sent, of each priority: the most that Zenoh allows


# How long one who asks and doesn't read the answers holds up all that the listener passes on, heartbeats too,
# before its link is cut. Zenoh's own 5 s are the watchdog's: all processes would be taken for dead.
_ASKER_US = 1_500_000
# How long a session on another host tries to reach the listener before it gives up.
_REACH_MS = 5_000


def open_session(
    config: BusConfig,
    listen: bool,
    client: bool = False,
    network: NetworkConfig | None = None,
    lossless: bool = False,
) -> Any:
    """A Zenoh session that listens on the endpoint, or that connects to it and to those who do so too.

    On the listener's host it opens at once and goes on trying; on another host it is a client of the
    listener, because the direct links stay on the host. ``client``: be one here too, which is linked once
    this returns, for a question and no more. ``network``: its endpoint is listened on too, and its
    certificates are shown. ``lossless``: lockstep, where who is behind is waited for. Raises ConfigError for
    a certificate that a TLS endpoint needs and that can't be read, and BusError if the endpoint is malformed,
    can't be listened on or, from another host, is not reached in time.
    """
    endpoint, network = check_endpoint(config.endpoint), network or NetworkConfig()
    if protocol_of(endpoint) in SECURE:  # or we would wait for an answer that can't come
        check_files(network)
    if listen:
        if protocol_of(endpoint) != _SOCKET:
            _check_loopback()
        both = [endpoint, network.endpoint] if network.endpoint else [endpoint]
        links: dict[str, Any] = {"mode": "peer", "listen/endpoints": both, "connect/endpoints": []}
        links["scouting/gossip/autoconnect"] = {"peer": []}  # they come to us
        if not lossless:
            links["transport/link/tx/queue/congestion_control/block/wait_before_close"] = _ASKER_US
    elif on_this_host(endpoint) and not client:
        links = {
            "mode": "peer",
            "listen/endpoints": [_direct(endpoint)],
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
            "open/return_conditions/connect_scouted": False,  # or it waits half a second for company
        }
    else:
        links = {"mode": "client", "connect/endpoints": [endpoint], "connect/timeout_ms": _REACH_MS}
    if links["mode"] == "peer" and protocol_of(endpoint) == _SOCKET:
        sweep(address_of(endpoint))
    try:
        rules = {} if links["mode"] == "client" else access_control(network, listen)
        return zenoh.open(_zenoh_config(links | rules | tls(network), config.retry_ms))
    except zenoh.ZError as error:
        setting, failed = "bus.endpoint", endpoint
        if listen and _is_of(str(error), network.endpoint):
            setting, failed = "network.endpoint", network.endpoint
        raise BusError(f"{setting}: {_why_not(failed, error)}") from None


def _check_loopback() -> None:
    """Raises BusError where loopback is down (a bare `unshare -n`, say): nobody would ever be heard."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("127.0.0.1", 9))  # asks for the way alone: nothing is sent
        except OSError as error:
            why = f"127.0.0.1 can't be reached ({error.strerror})"
            raise BusError(f"bus.endpoint: {why}: is loopback up (ip link set lo up)?") from None


def _direct(endpoint: str) -> str:
    """Where a session accepts the others' direct links: this host alone, as internal messages stay there.

    Who keeps the endpoint in a folder of his own would find loopback open to every account: beside it, then.
    """
    if protocol_of(endpoint) != _SOCKET:
        return _DIRECT
    return f"{_SOCKET}/{address_of(endpoint)}.{os.getpid()}.{next(_sessions)}"


def on_this_host(endpoint: str) -> bool:
    """Whether the endpoint's address is one of this host's own: one that a socket can be bound to."""
    protocol, _, address = endpoint.partition("/")
    if protocol == _SOCKET:
        return True
    host = address.rpartition(":")[0].strip("[]")
    try:
        for family, kind, _, _, own in socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM):
            with socket.socket(family, kind) as probe:
                probe.bind(own)
                return True
    except (OSError, UnicodeError):  # no such host, or a name that can't be one
        pass
    return False


def _zenoh_config(links: dict[str, Any], retry_ms: int) -> Any:
    priorities = {topic.priority for topic in TOPICS.values()}
    settings: dict[str, Any] = {
        **links,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "listen/exit_on_failure": True,
        "connect/retry": {
            "period_init_ms": retry_ms,
            "period_max_ms": retry_ms,
            "period_increase_factor": 1,
        },
        # A frame of 460 kB is eight batches: with the default of two it would wait for the receiver's thread.
        # And poses would be lost as soon as the sending thread got no processor for a tenth of a second.
        **{f"transport/link/tx/queue/size/{priority}": _BATCHES for priority in priorities},
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": _PATIENCE_US,
        # With a small memlock limit, subscribers would silently receive nothing.
        "transport/shared_memory/enabled": False,
    }
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return config


def _is_of(error: str, endpoint: str) -> bool:
    """Whether Zenoh's error names the endpoint's address."""
    address = re.escape(address_of(endpoint))
    return bool(address) and re.search(rf"(?<![\w.]){address}(?!\d)", error) is not None


def _why_not(endpoint: str, error: Exception) -> str:
    said = str(error)
    # The last is a socket's, which Zenoh holds by a lock beside it.
    if "in use" in said or "os error 98" in said or "Unable to acquire lock" in said:
        return in_use(endpoint)
    if "Unable to connect" in said:
        nobody = f"nobody answers at {endpoint}; is prism-edge running there"
        if protocol_of(endpoint) in SECURE:
            nobody += ", and are the certificates of one authority (prism-edge doctor --config FILE)"
        return f"{nobody}?"
    # without the place in Zenoh's own source
    reason = re.sub(r" at /\S+\.rs:\d+\.?\]?", "", first_line(error))
    return f"can't open {endpoint}: {reason[:160]}"


def encoding(topic: Topic) -> Any:
    """What Zenoh tells subscribers about the payload: CDR with the ROS type's name, or our own layout."""
    if isinstance(topic.type, str):
        return zenoh.Encoding.APPLICATION_CDR.with_schema(topic.type)
    return zenoh.Encoding.APPLICATION_OCTET_STREAM.with_schema(f"prism_edge.{topic.type.__name__}")


def quality(topic: Topic, lossless: bool) -> dict[str, Any]:
    """Arguments of ``declare_publisher``; ``lossless``: lockstep, where everything must arrive.

    In real time nothing blocks: a subscriber that hangs (a suspended terminal is enough) would hold up the
    tracker for five seconds, after which Zenoh cuts the link and does not restore it. Links are TCP and
    receivers never stop reading, so only one that hangs, megabytes behind, loses messages.
    """
    reliable = topic.reliable or lossless
    return {
        "encoding": encoding(topic),
        "priority": getattr(zenoh.Priority, topic.priority.upper()),
        "reliability": zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT,
        "congestion_control": zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP,
        # Batching waits for more messages to share a packet; at these rates that is only delay.
        "express": topic.rate_hz >= 10.0,
    }
