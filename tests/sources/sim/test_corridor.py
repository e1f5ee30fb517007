"""The corridor: doors at equal distances, each stretch the picture of the next, and depth by ray casting."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from sources.sim.conftest import CLEAN
from sources.sim.ray_casting import agreement

from prism_edge.sources.sim import SimSource, corridor


@pytest.fixture(scope="module")
def equal() -> Iterator[SimSource]:
    """All stretches the same, through a faultless camera."""
    with SimSource(f"sim:corridor?seed=2&unlike=0&{CLEAN}") as source:
        yield source


def test_depth_is_what_rays_find(equal: SimSource) -> None:
    assert agreement(equal, (0, 300, 610)) > 0.97  # some lie on an edge


def test_one_door_on_it_looks_the_same(equal: SimSource) -> None:
    renderer, _ = equal._opened()
    here = equal.pose(0)
    there = here.copy()
    there[0, 3] += corridor.EVERY
    near = renderer.depth(here, {}) < 4.0  # farther off the corridor's end comes nearer
    pictures = [renderer.draw(pose, {}).pixels.astype(int) for pose in (here, there)]
    assert near.mean() > 0.3
    difference = np.abs(pictures[0] - pictures[1]).max(axis=2)
    assert np.percentile(difference[near], 99) <= 1  # it may be rounded otherwise
    halfway = here.copy()
    halfway[0, 3] += corridor.EVERY / 2
    other = np.abs(pictures[0] - renderer.draw(halfway, {}).pixels).max(axis=2)
    assert np.median(other[near]) > 2


def test_stretches_differ_where_they_are_to() -> None:
    with SimSource(f"sim:corridor?seed=2&unlike=1&{CLEAN}") as source:
        renderer, _ = source._opened()
        here = source.pose(0)
        there = here.copy()
        there[0, 3] += corridor.EVERY
        near = renderer.depth(here, {}) < 4.0
        pictures = [renderer.draw(pose, {}).pixels.astype(int) for pose in (here, there)]
        assert np.median(np.abs(pictures[0] - pictures[1]).max(axis=2)[near]) > 2


def test_the_walk_keeps_between_the_walls_and_off_the_ends(equal: SimSource) -> None:
    _, poses = equal.truth()
    room = equal.plan.rooms[0]
    places = poses[:, :3, 3]
    assert np.all(places[:, :2] > room.low + 0.3)
    assert np.all(places[:, :2] < room.high - 0.3)
    assert np.ptp(places[:, 0]) > 15.0
    assert places[-1] == pytest.approx(places[0], abs=0.6)
