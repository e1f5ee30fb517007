"""Metrics as a scraper reads them."""

from __future__ import annotations

import builtins
import socket
import threading
import urllib.request
from dataclasses import replace
from typing import Any

import psutil
import pytest
from prometheus_client.parser import text_string_to_metric_families

from prism_edge.config import BusConfig, Config, MetricsConfig, NetworkConfig
from prism_edge.errors import ConfigError
from prism_edge.supervisor import metrics
from prism_edge.supervisor.health import ERROR, OK, Row, summary
from prism_edge.supervisor.metrics import MetricsServer, check_port
from tests.supervisor.whole_runs import DEADLINE_S


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def scraped(port: int) -> dict[tuple[str, ...], float]:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
        text = answer.read().decode()
    return {
        (sample.name, *(sample.labels[k] for k in ("process", "name") if k in sample.labels)): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_figures_of_health_are_metrics() -> None:
    rows = [
        Row("tracker", OK, "idle", {"pid": "7", "restarts": "2", "fps": "29.5", "map": "ok", "x": "nan"}),
        Row("depth", ERROR, 'broken "network"\n', {"restarts": "0", "inference_ms": "41"}),
    ]
    port = free_port()
    server = MetricsServer(port, lambda: [summary(rows, 1, 0.7), *rows])
    server.start()
    try:
        found = scraped(port)
        assert found["prism_edge_up",] == 0  # depth is in error
        assert found["prism_edge_level", "tracker"] == OK
        assert found["prism_edge_level", "depth"] == ERROR
        assert found["prism_edge_restarts_total", "tracker"] == 2
        assert found["prism_edge_value", "tracker", "fps"] == 29.5
        assert found["prism_edge_value", "depth", "inference_ms"] == 41
        assert not any("pid" in key or "map" in key or "x" in key for key in found)
        del rows[1]
        assert scraped(port)["prism_edge_up",] == 1
    finally:
        server.close()
    with pytest.raises(OSError):  # noqa: PT011 - whatever says that nobody is there
        scraped(port)


def test_it_listens_on_loopback_alone() -> None:
    port = free_port()
    server = MetricsServer(port, list)
    server.start()
    try:
        listening = {c.laddr.ip for c in psutil.Process().net_connections("tcp") if c.laddr.port == port}
        assert listening == {"127.0.0.1"}
    finally:
        server.close()


def test_it_has_no_thread_before_it_starts() -> None:
    """Workers start as forks of a process that has none."""
    before = set(threading.enumerate())
    MetricsServer(free_port(), list).close()
    assert set(threading.enumerate()) <= before  # another test's may be about to end


def test_a_port_taken_since_is_the_users_error() -> None:
    port = free_port()
    server = MetricsServer(port, list)
    with socket.socket() as other:
        other.bind(("127.0.0.1", port))
        other.listen()
        with pytest.raises(ConfigError, match=r"metrics\.port: can't listen"):
            server.start()
    server.close()


def test_a_request_that_never_ends_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "PATIENCE_S", 0.1)
    server = MetricsServer(port := free_port(), list)
    server.start()
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=DEADLINE_S) as client:
            client.sendall(b"GET /met")
            assert client.recv(1) == b""  # closed, and its thread gone
    finally:
        server.close()


def test_a_port_in_use_is_the_users_error() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(ConfigError, match=r"metrics\.port: can't listen"):
            MetricsServer(other.getsockname()[1], list)


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name == "prometheus_client":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ConfigError, match=r"pip install 'prism-edge\[metrics\]'"):
        MetricsServer(free_port(), list)


@pytest.mark.parametrize(
    ("bus", "network", "whose"),
    [
        ("tcp/127.0.0.1:9400", "", "bus.endpoint"),
        ("tcp/localhost:9400", "", "bus.endpoint"),
        ("tcp/127.0.0.1:7447", "tls/0.0.0.0:9400", "network.endpoint"),
        ("tcp/127.0.0.1:7447", "tls/192.168.1.7:9400", None),
        ("unixsock-stream//run/9400", "", None),
    ],
)
def test_a_port_that_the_run_listens_on_itself_is_refused(bus: str, network: str, whose: str | None) -> None:
    config = Config(
        bus=BusConfig(bus), network=NetworkConfig(endpoint=network), metrics=MetricsConfig(port=9400)
    )
    check_port(replace(config, metrics=MetricsConfig()))
    if whose is None:
        check_port(config)
        return
    with pytest.raises(ConfigError, match=rf"metrics\.port: {whose} has this port"):
        check_port(config)
