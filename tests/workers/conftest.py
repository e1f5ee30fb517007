"""Fixtures of the workers' tests (a module's own of the same name goes first)."""

from __future__ import annotations

import pytest

from tests.workers.list_bus import ListBus
from tests.workers.tracker_bench import World


@pytest.fixture
def bus():
    return ListBus("frame")


@pytest.fixture
def world(bus):
    return World(bus)
