"""Sessions that find each other, on ports of their own."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zenoh

from prism_edge import messages as m
from prism_edge.bus import leaving, links, ros
from prism_edge.bus.codec import pack
from prism_edge.bus.session import Bus
from prism_edge.errors import BusError, ConfigError
from tests.bus.examples import end, frame, linked, same, tracked
from tests.waiting import until

CHECKOUT = Path(__file__).resolve().parents[2]


def test_the_first_message_after_await_ready_arrives(join):
    join("supervisor", listen=True)
    tracker = join("tracker")
    inbox = tracker.queue("frame")
    tracker.pulse.ready()
    for i in range(10):
        with_source = join("source")
        assert with_source.await_ready(["tracker"], 10.0) == set()
        with_source.publish("frame", frame(i))
        received = inbox.take(10.0)
        assert received is not None
        assert same(received, frame(i))
        with_source.close()


def test_await_ready_names_who_is_missing(join):
    join("supervisor", listen=True)
    source, tracker = join("source"), join("tracker")
    assert source.await_ready(["tracker", "depth", "source"], 0.1) == {"tracker", "depth"}
    tracker.pulse.ready()
    assert source.await_ready(["tracker"], 10.0) == set()


def test_a_queue_gets_everything_in_order_and_latest_the_newest(join):
    join("supervisor", listen=True)
    tracker, backend = join("tracker"), join("backend")
    every, newest = backend.queue("tracked"), backend.latest("tracked")
    linked(tracker, backend)
    for i in range(50):
        tracker.publish("tracked", tracked(i))
    received = [every.take(10.0) for _ in range(50)]
    assert all(same(a, tracked(i)) for i, a in enumerate(received))
    index = -1
    while index < 49:  # the last may still be on its way; what was overtaken never comes
        later = newest.take(10.0)
        assert later is not None
        assert later.index > index
        index = later.index
    assert newest.take() is None


def test_whoever_comes_before_the_listener_is_linked_once_it_is_there(join):
    source, tracker = join("source"), join("tracker")
    inbox = tracker.queue("tracked")
    tracker.pulse.ready()
    join("supervisor", listen=True)
    assert source.await_ready(["tracker"], 10.0) == set()
    source.publish("tracked", tracked(1))
    assert inbox.take(10.0).index == 1


def test_workers_go_on_without_the_supervisor_and_newcomers_wait_for_the_next(join):
    first = join("supervisor", listen=True)
    tracker, backend = join("tracker"), join("backend")
    inbox = backend.queue("tracked")
    linked(tracker, backend)
    first.close()
    tracker.publish("tracked", tracked(1))
    assert inbox.take(10.0).index == 1
    depth = join("depth")
    late = depth.queue("tracked")
    depth.pulse.ready()
    assert tracker.await_ready(["depth"], 0.3) == {"depth"}
    join("supervisor", listen=True)
    assert tracker.await_ready(["depth"], 10.0) == set()
    tracker.publish("tracked", tracked(2))
    assert late.take(10.0).index == 2


def test_a_worker_that_is_restarted_is_linked_again(join):
    join("supervisor", listen=True)
    tracker, backend = join("tracker"), join("backend")
    linked(tracker, backend)
    backend.close()
    again = join("backend")
    inbox = again.queue("tracked")
    linked(tracker, again)
    tracker.publish("tracked", tracked(7))
    assert inbox.take(10.0).index == 7


def test_direct_messages_do_not_pass_through_the_supervisor(join):
    supervisor = join("supervisor", listen=True)
    tracker, backend = join("tracker"), join("backend")
    linked(tracker, backend)
    ids = {bus.process: str(bus._session.zid()) for bus in (supervisor, tracker, backend)}
    peers = {str(zid) for zid in tracker._session.info.peers_zid()}
    assert ids["backend"] in peers
    assert not list(tracker._session.info.routers_zid())


def test_an_outside_client_gets_public_topics_late_or_early(join, outside):
    join("supervisor", listen=True)
    early = outside().declare_subscriber("prism/*/odom")
    tracker = join("tracker")
    pose = np.eye(4)
    message = ros.odometry(5, "odom", "base_link", pose, np.eye(6), np.zeros(6), np.eye(6))

    def received(subscriber):
        tracker.publish("odom", message)
        return subscriber.try_recv()

    until(lambda: received(early))
    late = outside().declare_subscriber("prism/robot/odom")
    samples = []
    until(lambda: samples.append(received(late)) or samples[-1])
    sample = samples[-1]
    assert str(sample.encoding) == "application/cdr;nav_msgs/msg/Odometry"
    assert sample.priority == zenoh.Priority.REAL_TIME
    assert ros.deserialise(ros.ODOMETRY, sample.payload.to_bytes()).child_frame_id == "base_link"


def test_a_process_is_alive_for_an_outside_client_until_it_ends(join, outside):
    join("supervisor", listen=True)
    depth = join("depth")
    client = outside()

    def alive():
        replies = client.liveliness().get("prism/robot/alive/*", timeout=5.0)
        return {str(reply.ok.key_expr).rsplit("/", 1)[1] for reply in replies}

    until(lambda: alive() == {"supervisor", "depth"})
    depth.close()
    until(lambda: alive() == {"supervisor"})


def test_a_session_on_another_host_is_relayed(join, monkeypatch):
    join("supervisor", listen=True)
    tracker = join("tracker")
    inbox = tracker.queue("depth")
    monkeypatch.setattr(links, "on_this_host", lambda endpoint: False)
    remote = join("depth")
    images = remote.queue("tracked")
    linked(tracker, remote)
    tracker.publish("tracked", tracked(4))
    assert images.take(10.0).index == 4
    remote.publish("heartbeat", remote.pulse.beat())
    assert inbox.take() is None


FORGED = pack(m.Acknowledged("scale", 5))  # below another's key


@pytest.mark.parametrize("payload", [b"", b"PRSM garbage", pack(tracked(1)), FORGED])
def test_malformed_messages_are_counted_and_skipped(join, outside, caplog, payload):
    supervisor = join("supervisor", listen=True)
    inbox = supervisor.queue("acknowledged")
    client = outside()
    client.put("prism/robot/internal/acknowledged/depth", payload)
    client.put("prism/robot/internal/acknowledged/depth", pack(m.Acknowledged("depth", 5)))
    assert inbox.take(10.0) == m.Acknowledged("depth", 5)
    assert supervisor.pulse.values["malformed"] == "1"
    assert "prism/robot/internal/acknowledged/depth: malformed Acknowledged message" in caplog.text


def test_a_flood_of_malformed_messages_is_one_line(join, outside, caplog):
    supervisor = join("supervisor", listen=True)
    inbox = supervisor.queue("acknowledged")
    client = outside()
    for _ in range(50):
        client.put("prism/robot/internal/acknowledged/depth", b"garbage")
    client.put("prism/robot/internal/acknowledged/depth", pack(m.Acknowledged("depth", 5)))
    assert inbox.take(10.0) == m.Acknowledged("depth", 5)
    assert supervisor.pulse.values["malformed"] == "50"
    assert len([r for r in caplog.records if "malformed" in r.message]) == 1


def test_malformed_public_messages_are_skipped_too(join, outside):
    supervisor = join("supervisor", listen=True)
    inbox = supervisor.queue("status")
    client = outside()
    client.put("prism/robot/status", b"\0\1\0\0 no CDR")
    client.put("prism/robot/status", ros.serialise(ros.DIAGNOSTICS, ros.diagnostics(9, [])))
    assert ros.stamp_ns(inbox.take(10.0)) == 9


def test_robots_do_not_hear_each_other(join, config):
    supervisor = join("supervisor", listen=True)
    inbox = supervisor.queue("acknowledged")
    other = join("depth", config=replace(config, robot="other"))
    own = join("scale")
    own.pulse.ready()
    other.pulse.ready()
    other.await_ready(["supervisor"], 0.1)
    for _ in range(3):
        other.publish("acknowledged", m.Acknowledged("depth", 1))
    assert supervisor.await_ready(["scale"], 10.0) == set()
    own.publish("acknowledged", m.Acknowledged("scale", 2))
    assert inbox.take(10.0).process == "scale"


def test_what_a_topic_does_not_carry_is_refused(join):
    tracker = join("tracker")
    with pytest.raises(BusError, match="carries Tracked, not Frame"):
        tracker.publish("tracked", frame())
    with pytest.raises(BusError, match="nav_msgs/msg/Odometry"):
        tracker.publish("odom", ros.diagnostics(1, []))
    with pytest.raises(BusError, match="index"):
        tracker.publish("tracked", replace(tracked(), index="one"))


def test_bad_settings_are_told_before_anything_is_opened(config):
    with pytest.raises(ConfigError, match="robot"):
        Bus.open(replace(config, robot="a/b"), "source")
    with pytest.raises(BusError, match="no endpoint"):
        Bus.open(replace(config, bus=replace(config.bus, endpoint="tcp/here")), "source")


def test_an_endpoint_in_use_is_one_clear_line(join, config):
    join("supervisor", listen=True)
    with pytest.raises(BusError, match=f"{config.bus.endpoint} is in use"):
        Bus.open(config, "supervisor", listen=True)


def test_close_stops_the_waits_and_may_be_repeated(join):
    bus = join("tracker")
    inbox = bus.queue("frame")
    taken = []
    waiting = threading.Thread(target=lambda: taken.append(inbox.take(60.0)))
    waiting.start()
    bus.close()
    bus.close()
    waiting.join(10.0)
    assert taken == [None]
    assert bus.stopped.is_set()
    bus.publish("tracked", tracked())  # the last words of a worker that is being stopped


class Stuck:
    """A session that waits for a receiver which hangs, as Zenoh's does for ten seconds, and then says so."""

    def __init__(self, session, says):
        self._session, self._says = session, says
        self.goes_on = threading.Event()

    def __getattr__(self, name):
        return getattr(self._session, name)

    def close(self):
        assert self.goes_on.wait(60.0)
        self._session.close()
        if self._says:
            raise zenoh.ZError("close operation timed out!")


def test_leaving_waits_for_nobody_who_hangs(join, monkeypatch, caplog):
    bus = join("tracker")
    bus._session = Stuck(bus._session, says=False)
    monkeypatch.setattr(leaving, "PATIENCE_S", 0.01)
    bus.close()
    assert not bus._session.goes_on.is_set()
    assert "does not read" in caplog.text
    bus._session.goes_on.set()


def test_lockstep_waits_for_whoever_reads_slowly(join, config, monkeypatch):
    bus = Bus.open(replace(config, mode="lockstep"), "tracker")
    bus._session = stuck = Stuck(bus._session, says=True)
    monkeypatch.setattr(leaving, "PATIENCE_S", 0.01)
    threading.Timer(0.3, stuck.goes_on.set).start()
    bus.close()  # what Zenoh says at the end of its patience is no error of the run's
    assert stuck.goes_on.is_set()


PROCESS = """
import sys, threading
from dataclasses import replace
from prism_edge.bus.session import Bus
from prism_edge.config import BusConfig, Config
from prism_edge.messages import EndOfStream
config = replace(Config(), bus=BusConfig(endpoint=sys.argv[1], retry_ms=50))
bus = Bus.open(config, "source")
inboxes = [bus.queue("acknowledged"), bus.latest("tracked")]
bus.publish("end", EndOfStream(1, 1, 0, 0, 0))
bus.answer("map_snapshot", lambda: None)
bus.pulse.ready()
print("ready", flush=True)
if sys.argv[2] == "stay":
    threading.Event().wait(60)
if sys.argv[2] == "close":
    bus.close()
"""


def start(config, how):
    arguments = [sys.executable, "-c", PROCESS, config.bus.endpoint, how]
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True, cwd=CHECKOUT)
    assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.parametrize("how", ["close", "forget"])
def test_a_process_ends_with_its_queryables_and_threads(join, config, how):
    join("supervisor", listen=True)
    process = start(config, how)
    assert process.wait(20.0) == 0
    process.stdout.close()


def test_a_killed_process_is_noticed_and_its_successor_is_linked(join, config):
    join("supervisor", listen=True)
    tracker = join("tracker")
    for _ in range(2):
        process = start(config, "stay")
        assert tracker.await_ready(["source"], 10.0) == set()
        assert tracker.ask("end", 5.0) == end(0)
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        until(lambda: tracker.await_ready(["source"], 0.02) == {"source"})


def test_a_receiver_that_hangs_does_not_hold_up_the_publisher(join, config):
    join("supervisor", listen=True)
    tracker = join("tracker")
    process = start(config, "stay")
    try:
        assert tracker.await_ready(["source"], 10.0) == set()
        process.send_signal(signal.SIGSTOP)
        image = np.zeros((2000, 2000), np.uint8)
        done = threading.Event()

        def flood():  # 80 MB: more than sockets and queues hold
            for i in range(20):
                big = m.KeyframeImage(i, i, i, 0, False, "pinhole", np.arange(6.0), image)
                tracker.publish("keyframe_image", big)
                tracker.publish("tracked", tracked(i))
            done.set()

        threading.Thread(target=flood, daemon=True).start()
        assert done.wait(4.0)  # Zenoh's own patience is five seconds
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
