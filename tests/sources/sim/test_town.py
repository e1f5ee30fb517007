"""A town's map, the drive through it, and that a cell's portals show only what lies behind them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.sources.sim import SimSource, streets, town
from prism_edge.sources.sim.surfaces import DECAL


@given(st.integers(0, 2**31 - 1))
def test_a_drive_goes_through_every_street_and_never_straight_back(seed: int) -> None:
    tour = town.tour(np.random.default_rng(seed))
    around = [*tour, *tour[:2]]
    assert set(tour) == set(town.NODES)
    driven = {frozenset(pair) for pair in itertools.pairwise(around)}
    assert driven == {frozenset(pair) for pair in town.STREETS}
    assert all(before != after for before, after in zip(around, around[2:], strict=False))
    assert len(tour) <= 3 * len(town.STREETS)


def test_nine_crossings_twelve_streets() -> None:
    assert len(town.NODES) == 9
    assert len(set(town.STREETS)) == 12
    assert sorted(len(town.beside(node)) for node in town.NODES) == [2, 2, 2, 2, 3, 3, 3, 3, 4]
    for node in town.NODES:
        assert all(node in town.beside(other) for other in town.beside(node))


@pytest.mark.parametrize("seed", range(4))
def test_a_plan_has_streets_from_crossing_to_crossing_and_a_way_that_keeps_to_them(seed: int) -> None:
    plan = streets.make_town(seed)
    sizes = np.array([room.high - room.low for room in plan.rooms])
    assert sizes[:9] == pytest.approx(streets.CROSSING)
    assert np.sort(sizes[9:], axis=1)[:, 0] == pytest.approx(streets.WIDTH)
    assert 60.0 <= sizes[9:].max(axis=1).min() <= sizes.max() <= 120.0
    assert plan.route is not None
    inside = [
        np.all((plan.route > room.low) & (plan.route < room.high), axis=1).mean() for room in plan.rooms
    ]
    assert sum(inside) == pytest.approx(1.0, abs=0.01)
    assert min(inside) > 0.0


def test_crossings_open_into_the_streets_that_meet_there_and_have_walls_elsewhere(town_: SimSource) -> None:
    renderer, _ = town_._opened()
    cells = renderer.world.cells
    counts = [len(cell.portals) for cell in cells]
    assert sorted(counts[:9]) == [2, 2, 2, 2, 3, 3, 3, 3, 4]
    assert counts[9:] == [2] * 12
    for number, cell in enumerate(cells):
        opened = np.zeros(4)
        for portal in cell.portals:
            back = [p for p in cells[portal.into].portals if p.into == number]
            assert len(back) == 1
            assert {tuple(c) for c in portal.corners} == {tuple(c) for c in back[0].corners}
            axis = int(np.argmin(np.ptp(portal.corners, axis=0)))
            side = int(np.isclose(portal.corners[0, axis], cell.high[axis]))
            opened[2 * axis + side] += streets.WIDTH
        for axis, side in itertools.product((0, 1), (0, 1)):
            plane = (cell.low, cell.high)[side][axis]
            rows = cell.surfaces
            inward = rows.normal[:, axis] * (1 - 2 * side)
            walls = inward > 0.99 * np.linalg.norm(rows.normal, axis=1)
            walls &= (np.abs(rows.origin[:, axis] - plane) < 1e-6) & (rows.body < 0) & (rows.body != DECAL)
            area = np.linalg.norm(np.cross(rows.right[walls], rows.down[walls]), axis=1).sum()
            length = (cell.high - cell.low)[1 - axis] - opened[2 * axis + side]
            assert area == pytest.approx(length * streets.SKY, rel=1e-3, abs=1e-3)


def test_a_drive_through_town_is_as_long_as_a_sequence_of_the_road(town_: SimSource) -> None:
    _, way = town_.truth()
    driven = np.linalg.norm(np.diff(way[:, :3, 3], axis=0), axis=1).sum()
    assert 1200.0 < driven < 3500.0
