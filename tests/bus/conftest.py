"""A bus of its own for each test: a free port on loopback."""

from __future__ import annotations

from dataclasses import replace

import pytest
import zenoh

from prism_edge.bus.session import Bus
from prism_edge.bus.vacancy import free_endpoint
from prism_edge.config import BusConfig, Config


@pytest.fixture
def config() -> Config:
    """Defaults, with a listener that nobody else uses and quick retries."""
    return replace(Config(), bus=BusConfig(endpoint=free_endpoint(), retry_ms=50))


@pytest.fixture
def join(config):
    """Opens buses that are closed, newest first, at the end."""
    opened = []

    def open_bus(process, listen=False, config=config):
        opened.append(Bus.open(config, process, listen))
        return opened[-1]

    yield open_bus
    for bus in reversed(opened):
        bus.close()


@pytest.fixture
def outside(config):
    """A plain Zenoh client that knows nothing but the endpoint."""
    settings = f'{{mode: "client", connect: {{endpoints: ["{config.bus.endpoint}"]}}}}'
    opened = []

    def connect():
        opened.append(zenoh.open(zenoh.Config.from_json5(settings)))
        return opened[-1]

    yield connect
    for session in opened:
        session.close()
