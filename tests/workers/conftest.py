"""Fixtures of the workers' tests (a module's own of the same name goes first)."""

from __future__ import annotations

import pytest

from prism_edge.workers import arrivals, backend
from tests.workers.list_bus import ListBus
from tests.workers.tracker_bench import World


@pytest.fixture
def bus():
    return ListBus("frame")


@pytest.fixture
def world(bus):
    return World(bus)


@pytest.fixture
def impatient(monkeypatch):
    """A backend worker that doesn't wait long for what never comes."""
    monkeypatch.setattr(arrivals, "DEPTH_WAIT_S", 0.02)
    monkeypatch.setattr(backend, "_PATIENCE_S", 0.1)
    monkeypatch.setattr(backend, "_LOOK_S", 0.005)
