"""What was begun for one run of the robot is not told to the next, whose keyframes have the same numbers."""

from __future__ import annotations

import threading
from collections.abc import Callable

from prism_edge.bus.session import Bus
from prism_edge.messages import Epoch


def test_nothing_but_heartbeats(join: Callable[..., Bus]) -> None:
    began = threading.Event()
    first, remote = join("supervisor", listen=True), join("tracker")
    remote.on_another_run(began.set)
    remote.pulse.ready()
    assert first.await_ready(["tracker"], 10.0) == set()
    first.close()
    second = join("supervisor", listen=True)
    heard, beats = second.queue("new_map"), second.queue("heartbeat")
    assert began.wait(30.0)
    assert beats.take(10.0) is not None, "its sessions are not linked"
    remote.publish("new_map", Epoch(3))
    assert heard.take(1.0) is None
    assert beats.take(10.0) is not None, "it is still there"
