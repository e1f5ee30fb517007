"""Simulated sequences that several tests look at: small pictures, opened once."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from prism_edge.sources.sim import SimSource

SMALL = "width=160&height=120"
CLEAN = f"{SMALL}&noise=0&blur=0&exposure=0"


@pytest.fixture(scope="session")
def room() -> Iterator[SimSource]:
    """One room with people in it, through a faultless camera."""
    with SimSource(f"sim:room?seed=5&actors=3&{CLEAN}") as source:
        yield source


@pytest.fixture(scope="session")
def loop() -> Iterator[SimSource]:
    """The ring of rooms with people in it, through a faultless camera."""
    with SimSource(f"sim:loop?seed=6&actors=3&{CLEAN}") as source:
        yield source


@pytest.fixture(scope="session")
def street() -> Iterator[SimSource]:
    """Streets round a block, from a car, through a faultless camera."""
    with SimSource(f"sim:street?seed=4&rate=10&{CLEAN}") as source:
        yield source


@pytest.fixture(scope="session")
def town_() -> Iterator[SimSource]:
    """A town of crossings and streets, from a car, through a faultless camera."""
    with SimSource(f"sim:town?seed=4&rate=10&{CLEAN}") as source:
        yield source
