"""What `health` says, as Prometheus metrics on loopback (off by default; docs/OPERATIONS.md)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from prism_edge.errors import ConfigError
from prism_edge.supervisor.health import OK, WARN, Row

ADDRESS = "127.0.0.1"


class MetricsServer:
    """Answers http://127.0.0.1:PORT/metrics from threads of its own until closed."""

    def __init__(self, port: int, rows: Callable[[], Sequence[Row]]) -> None:
        """``rows`` gives the latest rows of `health`, the run's own first.

        Raises ConfigError where the library is missing or the port is taken.
        """
        try:
            from prometheus_client import CollectorRegistry, start_http_server
        except ImportError:
            raise ConfigError(
                "metrics.port: needs the package prometheus-client: pip install 'prism-edge[metrics]'"
            ) from None
        registry = CollectorRegistry()
        registry.register(_Collector(rows))
        try:
            self._server, self._thread = start_http_server(port, ADDRESS, registry)
        except OSError as error:
            raise ConfigError(f"metrics.port: can't listen on {ADDRESS}:{port}: {error.strerror}") from None

    def close(self) -> None:
        """Answer no more."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(timeout=2.0)


class _Collector:
    """Turns rows into metrics whenever somebody asks."""

    def __init__(self, rows: Callable[[], Sequence[Row]]) -> None:
        self._rows = rows

    def collect(self) -> Iterator[Any]:
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        level = GaugeMetricFamily(
            "prism_edge_level", "0 well, 1 warning, 2 error, 3 silent", labels=["process"]
        )
        up = GaugeMetricFamily("prism_edge_up", "1 where the run is ready and nothing is in error")
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
