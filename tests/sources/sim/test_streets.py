"""Streets: a ring of cells that open into each other, with walls wherever they don't, and a free way."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.sources.sim import SimSource, streets
from prism_edge.sources.sim.surfaces import DECAL


@pytest.mark.parametrize("seed", range(4))
def test_a_plan_is_a_ring_of_corners_and_streets_round_a_block(seed: int) -> None:
    plan = streets.make_plan(seed)
    sizes = np.array([room.high - room.low for room in plan.rooms])
    assert len(sizes) == 8
    assert sizes[::2] == pytest.approx(streets.WIDTH)  # corners
    assert np.sort(sizes[1::2], axis=1)[:, 0] == pytest.approx(streets.WIDTH)
    assert sizes[1::2].max(axis=1).min() >= 60.0
    assert sizes[1] == pytest.approx(sizes[5])  # opposite sides of the block
    assert sizes[3] == pytest.approx(sizes[7])
    assert plan.route is not None
    inside = [
        np.all((plan.route > room.low) & (plan.route < room.high), axis=1).mean() for room in plan.rooms
    ]
    assert sum(inside) == pytest.approx(1.0, abs=0.01)  # never in the block, or behind the houses
    assert min(inside) > 0.0


def test_neighbours_open_into_each_other_and_into_nobody_else(street: SimSource) -> None:
    renderer, _ = street._opened()
    cells = renderer.world.cells
    for number, cell in enumerate(cells):
        assert sorted(p.into for p in cell.portals) == sorted(((number + 1) % 8, (number - 1) % 8))
        for portal in cell.portals:
            back = [p for p in cells[portal.into].portals if p.into == number]
            assert len(back) == 1
            assert {tuple(c) for c in portal.corners} == {tuple(c) for c in back[0].corners}
            assert np.ptp(portal.corners, axis=0).tolist().count(0.0) == 1
            on_bounds = np.isclose(portal.corners[0], cell.low) | np.isclose(portal.corners[0], cell.high)
            assert on_bounds.any()
            axis = int(np.argmin(np.ptp(portal.corners, axis=0)))
            facing = np.argmax(np.abs(cell.surfaces.normal), axis=1) == axis
            blocking = facing & (np.abs(cell.surfaces.origin[:, axis] - portal.corners[0, axis]) < 1e-6)
            assert not blocking.any()


def test_what_stands_at_the_roadside_keeps_apart_and_off_the_way(street: SimSource) -> None:
    renderer, _ = street._opened()
    plan = renderer.world.plan
    assert plan.route is not None
    count = 0
    for cell in renderer.world.cells:
        low, high = cell.surfaces.body_low, cell.surfaces.body_high
        count += len(low)
        assert np.all(low[:, :2] > cell.low[:2] - 1e-9)
        assert np.all(high[:, :2] < cell.high[:2] + 1e-9)
        assert low[:, 2] == pytest.approx(0.0, abs=1e-9)
        for i in range(len(low)):
            others = np.arange(len(low)) != i
            meets = np.all((low[i] < high[others]) & (low[others] < high[i]), axis=1)
            assert not meets.any()
            gap = np.maximum(0.0, np.maximum(low[i, :2] - plan.route[::20], plan.route[::20] - high[i, :2]))
            assert np.linalg.norm(gap, axis=1).min() > 1.5
    assert count > 80


def test_lines_in_the_middle_of_each_street_are_seen_from_above(street: SimSource) -> None:
    renderer, _ = street._opened()
    for number, (cell, room) in enumerate(zip(renderer.world.cells, renderer.world.plan.rooms, strict=True)):
        lines = cell.surfaces.at(np.flatnonzero(cell.surfaces.body == DECAL))
        assert (len(lines.body) > 8) == bool(number % 2)
        middle = lines.origin + (lines.right + lines.down) / 2
        across = int(np.argmin(room.high - room.low))
        assert np.all(lines.normal[:, 2] > 0)
        assert middle[:, across] == pytest.approx(((room.low + room.high) / 2)[across])
        assert np.all((middle[:, :2] > room.low) & (middle[:, :2] < room.high))
