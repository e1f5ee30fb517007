"""What `health` says, as Prometheus metrics on loopback (off by default; docs/OPERATIONS.md)."""

from __future__ import annotations

import contextlib
import math
import socket
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from prism_edge.bus.keys import collide
from prism_edge.config import Config
from prism_edge.errors import ConfigError
from prism_edge.supervisor.health import OK, WARN, Row

ADDRESS = "127.0.0.1"
PATIENCE_S = 5.0  # with one who says nothing


def check_port(config: Config) -> None:
    """Raises ConfigError for a port on which the run itself listens for something else."""
    port = config.metrics.port
    for setting, endpoint in (("bus", config.bus.endpoint), ("network", config.network.endpoint)):
        if port and endpoint and collide(f"tcp/{ADDRESS}:{port}", endpoint.replace("localhost", ADDRESS)):
            raise ConfigError(f"metrics.port: {setting}.endpoint has this port ({endpoint}): take another")


class MetricsServer:
    """Answers http://127.0.0.1:PORT/metrics, from :meth:`start` until closed, in threads of its own."""

    def __init__(self, port: int, rows: Callable[[], Sequence[Row]]) -> None:
        """``rows`` gives the latest rows of `health`, the run's own first.

        Raises ConfigError where the library is missing or the port is taken.
        """
        try:
            from prometheus_client import CollectorRegistry
        except ImportError:
            raise ConfigError(
                "metrics.port: needs the package prometheus-client: pip install 'prism-edge[metrics]'"
            ) from None
        self._port, self._end = port, contextlib.ExitStack()
        self._registry = CollectorRegistry()
        self._registry.register(_Collector(rows))
        with self._port_is_free(), socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # what waits to time out owns nothing
            probe.bind((ADDRESS, port))

    def start(self) -> None:
        """Begin to answer. Raises ConfigError where the port has been taken since."""
        from prometheus_client import start_http_server

        with self._port_is_free():
            server, thread = start_http_server(self._port, ADDRESS, self._registry)
        server.RequestHandlerClass = _impatient(server.RequestHandlerClass)
        for end in (partial(thread.join, timeout=2.0), server.server_close, server.shutdown):  # last first
            self._end.callback(end)

    def close(self) -> None:
        """Answer no more."""
        self._end.close()

    @contextlib.contextmanager
    def _port_is_free(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise ConfigError(
                f"metrics.port: can't listen on {ADDRESS}:{self._port}: {error.strerror}"
            ) from None


def _impatient(handler: Any) -> Any:
    """Such a handler with a patience that ends: whoever asks holds a thread of the service's few."""

    class Impatient(handler):
        timeout = PATIENCE_S

        def handle(self) -> None:
            with contextlib.suppress(TimeoutError):
                super().handle()

    return Impatient


class _Collector:
    """Turns rows into metrics whenever somebody asks."""

    def __init__(self, rows: Callable[[], Sequence[Row]]) -> None:
        self._rows = rows

    def collect(self) -> Iterator[Any]:
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        level = GaugeMetricFamily(
            "prism_edge_level", "0 well, 1 warning, 2 error, 3 silent", labels=["process"]
        )
        up = GaugeMetricFamily("prism_edge_up", "1 where the run is ready and nothing is in error or silent")
        restarts = CounterMetricFamily("prism_edge_restarts", "starts after the first", labels=["process"])
        value = GaugeMetricFamily(
            "prism_edge_value", "each figure of health, under its name there", labels=["process", "name"]
        )
        for row in self._rows():
            level.add_metric([row.name], row.level)
            if row.name == "supervisor":
                up.add_metric([], float(row.values.get("state") == "ready" and row.level in (OK, WARN)))
            for name, text in row.values.items():
                number = _number(text)
                if number is None or name == "pid":
                    continue
                if name == "restarts":
                    restarts.add_metric([row.name], number)
                else:
                    value.add_metric([row.name, name], number)
        yield from (up, level, restarts, value)

    def describe(self) -> Sequence[Any]:
        """Nothing is known before anybody asks."""
        return ()


def _number(text: str) -> float | None:
    """The number that a value is, None where it is words."""
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None
