"""A Zenoh router, as a fleet has one: python tools/faults_router.py LISTEN [CONNECT ...]"""

from __future__ import annotations

import json
import sys
import threading

import zenoh


def main(listen: str, *connect: str) -> None:
    """Route until killed; endpoints that are not there yet are tried again."""
    config = zenoh.Config()
    settings = {
        "mode": "router",
        "listen/endpoints": [listen],
        "connect/endpoints": list(connect),
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 100, "period_increase_factor": 1},
        "scouting/multicast/enabled": False,
        # A daemon's processes link to each other, not through the one that listens: so must whoever routes.
        "scouting/gossip/autoconnect": {"router": ["router", "peer"], "peer": ["router", "peer"]},
        "transport/shared_memory/enabled": False,
    }
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    with zenoh.open(config):
        print("ready", flush=True)
        threading.Event().wait()


if __name__ == "__main__":
    main(*sys.argv[1:])
