"""Clients that ask for much and don't read the answers."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time

import numpy as np
import zenoh

from prism_edge import messages as m
from prism_edge.bus.keys import address_of, key
from prism_edge.supervisor.liveness import SILENT_S
from prism_edge.topics import TOPICS
from tests.bus.examples import tracked
from tests.waiting import until

PICTURE = np.zeros((256, 256), np.uint8)
ASKED = 400  # 26 MB of answers: more than sockets and queues hold
BEAT_S = 0.02


class Stalling:
    """A relay of one connection to ``there``, which reads no answers while ``reads`` is not set."""

    def __init__(self, there: tuple[str, int]) -> None:
        self.reads, self._there = threading.Event(), there
        self.reads.set()
        self._server = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._server.getsockname()[1]}"
        threading.Thread(target=self._relay, daemon=True).start()

    def _relay(self) -> None:
        always = threading.Event()
        always.set()
        with self._server.accept()[0] as near, socket.socket() as far:
            self._server.close()
            far.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
            far.connect(self._there)
            threading.Thread(target=self._carry, args=(near, far, always), daemon=True).start()
            self._carry(far, near, self.reads)

    @staticmethod
    def _carry(source: socket.socket, sink: socket.socket, may: threading.Event) -> None:
        with contextlib.suppress(OSError):
            while may.wait() and (data := source.recv(1 << 16)):
                sink.sendall(data)


def test_one_who_asks_and_does_not_read_is_cut_off_before_processes_seem_dead(join, config):
    supervisor, source = join("supervisor", listen=True), join("source")
    heard = supervisor.queue("tracked", 4096)
    picture = m.KeyframeImage(0, 0, 0, 0, False, "pinhole", np.arange(6.0), PICTURE)
    source.answer("keyframe_image", lambda: picture)
    host, _, port = address_of(config.bus.endpoint).rpartition(":")
    relay = Stalling((host, int(port)))
    settings = {"mode": "client", "connect": {"endpoints": [relay.endpoint]}}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(settings))) as client:
        where = key(config.robot, TOPICS["keyframe_image"])
        until(lambda: any(reply.ok for reply in client.get(where, timeout=5.0)), "an answer")
        relay.reads.clear()
        asked = [client.get(where, zenoh.handlers.RingChannel(1), timeout=30.0) for _ in range(ASKED)]
        longest = _longest_gap(source, heard, 0.6 * SILENT_S)
        assert len(asked) == ASKED
        assert longest < SILENT_S / 2
        relay.reads.set()


def _longest_gap(source, heard, for_s):
    """The longest time without a message, of many in a row, for so many seconds."""
    began = last = time.monotonic()
    longest, sent = 0.0, 0
    while (now := time.monotonic()) - began < for_s:
        if now - began >= sent * BEAT_S:
            source.publish("tracked", tracked(sent))
            sent += 1
        if heard.take(BEAT_S) is not None:
            longest, last = max(longest, time.monotonic() - last), time.monotonic()
    return max(longest, time.monotonic() - last)
