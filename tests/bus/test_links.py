"""Endpoints of sessions and the quality of service of topics."""

from __future__ import annotations

import itertools
import os
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil
import pytest
import zenoh

from prism_edge.bus import links
from prism_edge.bus.links import encoding, on_this_host, open_session, quality
from prism_edge.bus.vacancy import free_endpoint
from prism_edge.config import BusConfig, Config, NetworkConfig
from prism_edge.errors import BusError, ConfigError
from prism_edge.topics import TOPICS
from tests.waiting import until


def test_an_endpoint_in_use_is_named(config):
    with open_session(config.bus, listen=True), pytest.raises(BusError, match="is in use") as caught:
        open_session(config.bus, listen=True)
    assert config.bus.endpoint in str(caught.value)
    assert "\n" not in str(caught.value)


def test_of_two_endpoints_the_one_that_fails_is_named(config):
    free, taken = free_endpoint(), config.bus.endpoint
    with open_session(config.bus, listen=True):
        for ours, theirs, setting in ((free, taken, "network"), (taken, free, "bus")):
            with pytest.raises(BusError, match=rf"^{setting}\.endpoint: {taken} is in use already") as caught:
                open_session(BusConfig(endpoint=ours), listen=True, network=NetworkConfig(endpoint=theirs))
            assert free not in str(caught.value)
    elsewhere = NetworkConfig(endpoint="tcp/192.0.2.1:7447")
    with pytest.raises(BusError, match=r"^network\.endpoint: can't open tcp/192\.0\.2\.1:7447"):
        open_session(BusConfig(endpoint=free), listen=True, network=elsewhere)


def test_a_socket_in_use_is_named(tmp_path):
    config = BusConfig(endpoint=f"unixsock-stream/{tmp_path}/bus")
    with open_session(config, listen=True), pytest.raises(BusError, match="is in use") as caught:
        open_session(config, listen=True)
    assert config.endpoint in str(caught.value)


@pytest.mark.parametrize("endpoint", ["tcp/192.0.2.1:7447", "unixsock-stream//nowhere/at/all"])
def test_an_endpoint_that_is_not_ours_can_not_be_listened_on(endpoint):
    with pytest.raises(BusError, match="can't open") as caught:
        open_session(BusConfig(endpoint=endpoint), listen=True)
    assert endpoint in str(caught.value)
    assert ".rs:" not in str(caught.value)


def test_on_this_host_an_absent_listener_is_waited_for_in_the_background(config):
    with open_session(config.bus, listen=False) as session:
        assert not session.is_closed()


def test_from_another_host_an_absent_listener_is_an_error(monkeypatch):
    monkeypatch.setattr(links, "on_this_host", lambda endpoint: False)
    monkeypatch.setattr(links, "_REACH_MS", 100)
    with pytest.raises(BusError, match="nobody answers at"):
        open_session(BusConfig(endpoint=free_endpoint()), listen=False)


def test_where_a_tls_link_fails_certificates_are_asked_about(monkeypatch):
    """Zenoh says the same of nobody there and of a certificate that is not taken."""
    monkeypatch.setattr(links, "on_this_host", lambda endpoint: False)
    monkeypatch.setattr(links, "_REACH_MS", 100)
    with pytest.raises(BusError, match=r"and are the certificates of one authority \(prism-edge doctor"):
        open_session(BusConfig(endpoint=free_endpoint().replace("tcp/", "tls/")), listen=False)


@pytest.mark.parametrize("client", [False, True])
def test_a_certificate_that_is_not_there_is_said_before_anybody_waits(client):
    """Here a listener that can't be reached yet is waited for: one that never will be is no reason to."""
    network = NetworkConfig(ca="/nowhere/ca.pem")
    with pytest.raises(ConfigError, match=r"network\.ca: can't read /nowhere/ca\.pem"):
        open_session(BusConfig(endpoint="tls/localhost:7448"), listen=False, client=client, network=network)
    with open_session(BusConfig(endpoint=free_endpoint()), listen=False, network=network) as session:
        assert not session.is_closed()  # the robot's own link needs none


@pytest.mark.parametrize(
    ("endpoint", "here"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/localhost:7447", True),
        ("tcp/0.0.0.0:7447", True),
        ("unixsock-stream//tmp/x", True),
        ("tcp/192.0.2.1:7447", False),  # set aside for documentation (RFC 5737)
        ("tcp/nowhere.invalid:7447", False),
        ("tcp/robot..local:7447", False),
        (f"tcp/{'x' * 64}.local:7447", False),
    ],
)
def test_this_host_is_told_from_others(endpoint, here):
    assert on_this_host(endpoint) is here


def test_behind_a_socket_in_a_private_folder_nothing_listens_on_loopback(tmp_path):
    config = BusConfig(endpoint=f"unixsock-stream/{tmp_path}/bus")
    heard: list[bytes] = []
    with open_session(config, listen=False) as speaker, open_session(config, listen=False) as hearer:
        subscriber = hearer.declare_subscriber("said", lambda sample: heard.append(sample.payload.to_bytes()))
        with open_session(config, listen=True):
            until(lambda: len(list(hearer.info.peers_zid())) == 2)
            states = [connection.status for connection in psutil.Process().net_connections("inet")]
            assert psutil.CONN_LISTEN not in states
        # The listener has gone: what is heard now came by the link that the two have with each other.
        publisher = speaker.declare_publisher("said")
        until(lambda: publisher.matching_status.matching)
        publisher.put(b"direct")
        until(lambda: heard == [b"direct"])
        subscriber.undeclare()
    assert list(tmp_path.iterdir()) == []


def test_beside_an_endpoint_that_is_no_socket_nothing_is_swept(config, monkeypatch):
    """The name of a file would be made of a port."""
    swept: list[str] = []
    monkeypatch.setattr(links, "sweep", swept.append)
    for listen in (True, False):
        open_session(config.bus, listen=listen).close()
    assert not swept


@pytest.fixture
def short_folder():
    """pytest's own are too long for a path of a given length below 107 bytes."""
    with TemporaryDirectory(dir="/tmp") as folder:
        yield Path(folder)


def test_at_the_longest_path_that_a_socket_may_have_all_processes_can_listen(short_folder, monkeypatch):
    """The largest PID of Linux and the last session there is room for come to the last byte."""
    monkeypatch.setattr(os, "getpid", lambda: 4194304)
    monkeypatch.setattr(links, "_sessions", itertools.count(9999))
    path = short_folder / "b".ljust(94 - len(f"{short_folder}/"), "x")
    config = BusConfig(endpoint=f"unixsock-stream/{path}")
    with open_session(config, listen=True), open_session(config, listen=False):
        beside = Path(f"{path}.4194304.9999")
        assert len(str(beside)) == 107
        assert beside.is_socket()
    longer = BusConfig(endpoint=f"{config.endpoint}x")
    for listen in (True, False):
        with pytest.raises(BusError, match="path has 95 bytes"):
            open_session(longer, listen=listen)


def test_a_socket_of_the_network_may_be_as_long_as_any(short_folder):
    """Nobody listens beside it."""
    path = short_folder / "n".ljust(107 - len(f"{short_folder}/"), "x")
    network = NetworkConfig(endpoint=f"unixsock-stream/{path}")
    with open_session(BusConfig(endpoint=free_endpoint()), listen=True, network=network):
        assert path.is_socket()


def test_settings_behind_a_sockets_path_are_not_of_it(tmp_path):
    """Else the processes' own path would be the bus's, with other settings."""
    config = BusConfig(endpoint=f"unixsock-stream/{tmp_path}/bus#a=b")
    with open_session(config, listen=False), open_session(config, listen=True):
        assert (tmp_path / "bus").is_socket()
        assert len([path for path in tmp_path.glob("bus.*.*") if path.is_socket()]) == 1


def test_in_real_time_nothing_blocks_and_in_lockstep_nothing_is_dropped():
    for topic in TOPICS.values():
        assert quality(topic, lossless=False)["congestion_control"] == zenoh.CongestionControl.DROP
        assert quality(topic, lossless=True)["congestion_control"] == zenoh.CongestionControl.BLOCK
    assert quality(TOPICS["frame"], lossless=False)["reliability"] == zenoh.Reliability.BEST_EFFORT
    assert quality(TOPICS["frame"], lossless=True)["reliability"] == zenoh.Reliability.RELIABLE


@pytest.mark.parametrize("priority", sorted({topic.priority for topic in TOPICS.values()}))
def test_what_is_public_outlasts_a_sending_thread_that_stands_for_a_quarter_of_a_second(priority):
    a_second = sum(t.rate_hz for t in TOPICS.values() if not t.internal and t.priority == priority)
    config = links._zenoh_config({}, retry_ms=100)
    room = int(config.get_json(f"transport/link/tx/queue/size/{priority}"))
    assert room == links._BATCHES >= a_second / 4


def test_every_topic_has_a_priority_that_zenoh_knows():
    for topic in TOPICS.values():
        assert isinstance(quality(topic, False)["priority"], zenoh.Priority)
    assert quality(TOPICS["odom"], False)["priority"] == zenoh.Priority.REAL_TIME
    with pytest.raises(AttributeError):
        quality(replace(TOPICS["odom"], priority="urgent"), False)


def test_encodings_name_the_type():
    assert str(encoding(TOPICS["odom"])) == "application/cdr;nav_msgs/msg/Odometry"
    assert str(encoding(TOPICS["frame"])) == "application/octet-stream;prism_edge.Frame"


def test_the_default_endpoint_is_on_loopback():
    assert Config().bus.endpoint.startswith("tcp/127.0.0.1:")
