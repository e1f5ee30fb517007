"""How processes reach each other: Zenoh's configuration, and each topic's quality of service."""

from __future__ import annotations

import json
from typing import Any

import zenoh

from prism_edge.bus.keys import check_endpoint
from prism_edge.config import BusConfig
from prism_edge.errors import BusError
from prism_edge.topics import Topic

# Where a worker accepts the others' direct links: loopback alone, so that internal messages stay on the host.
_DIRECT = "tcp/127.0.0.1:0"
# How long a publisher waits, once, for a receiver that is megabytes behind, before it drops what is for it.
_PATIENCE_US = 50_000


def open_session(config: BusConfig, listen: bool) -> Any:
    """A Zenoh session that listens on the endpoint, or that goes on trying to connect to it.

    Raises BusError if the endpoint is malformed, or can't be listened on.
    """
    endpoint = check_endpoint(config.endpoint)
    try:
        return zenoh.open(_zenoh_config(endpoint, config.retry_ms, listen))
    except zenoh.ZError as error:
        raise BusError(_why_not(endpoint, str(error))) from None


def _zenoh_config(endpoint: str, retry_ms: int, listen: bool) -> Any:
    settings: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "listen/endpoints": [endpoint if listen else _DIRECT],
        "listen/exit_on_failure": True,
        "connect/endpoints": [] if listen else [endpoint],
        # return from open() at once and try for ever, in the background
        "open/return_conditions/connect_scouted": False,
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {
            "period_init_ms": retry_ms,
            "period_max_ms": retry_ms,
            "period_increase_factor": 1,
        },
        # A frame of 460 kB is eight batches: with the default of two it would wait for the receiver's thread.
        "transport/link/tx/queue/size/data": 16,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": _PATIENCE_US,
        # With a small memlock limit, subscribers would silently receive nothing.
        "transport/shared_memory/enabled": False,
    }
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return config


def _why_not(endpoint: str, error: str) -> str:
    if "in use" in error or "os error 98" in error:
        return f"bus.endpoint: {endpoint} is in use already; is another prism-edge running?"
    return f"bus.endpoint: can't open {endpoint}: {error.splitlines()[0][:160]}"


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
