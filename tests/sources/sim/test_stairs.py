"""The staircase: steps where they are said to be, each the picture of the next, and a way above them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from sources.sim.conftest import CLEAN
from sources.sim.ray_casting import agreement

from prism_edge.geometry.poses import Array
from prism_edge.sources.sim import SimSource
from prism_edge.sources.sim.stairs import LANDING, Flight


@pytest.fixture(scope="module")
def equal() -> Iterator[SimSource]:
    """All steps the same, through a faultless camera."""
    with SimSource(f"sim:stairs?seed=2&unlike=0&{CLEAN}") as source:
        yield source


def ground(flight: Flight, x: Array) -> Array:
    """How high what is stood on is, at distances (n,) along the flight."""
    return np.clip(np.floor(x / flight.tread) + 1.0, 0.0, flight.steps) * flight.riser


@pytest.mark.parametrize("seed", range(6))
def test_steps_are_as_houses_have_them_and_what_is_seen_lies_on_them(seed: int) -> None:
    flight = Flight.of(seed)
    assert 11 <= flight.steps <= 15
    assert 0.55 < 2 * flight.riser + flight.tread < 0.68  # what a stride is
    with SimSource(f"sim:stairs?seed={seed}&{CLEAN}") as source:
        checked = 0
        for index in (0, source.frame_count // 4, source.frame_count // 2):
            pose, depth = source.pose(index), source.depth(index)
            y, x = np.mgrid[:120, :160]
            rays = np.stack([(x - 79.5) / source.camera.fx, (y - 59.5) / source.camera.fy, np.ones(x.shape)])
            seen = (rays * depth).reshape(3, -1).T @ pose[:3, :3].T + pose[:3, 3]
            room = source.plan.rooms[0]
            inside = np.all((seen[:, :2] > room.low - 0.02) & (seen[:, :2] < room.high + 0.02), axis=1)
            assert inside.mean() > 0.999  # a pixel on an edge may have its neighbour's plane
            middle = inside & (np.abs(seen[:, 1]) < flight.width / 2 - 0.2)  # neither walls nor rails
            middle &= (seen[:, 0] > -LANDING + 0.1) & (seen[:, 0] < room.high[0] - 0.1)
            middle &= seen[:, 2] < room.height - 0.1
            along, height = seen[middle, 0], seen[middle, 2]
            below, above = ground(flight, along - 0.02), ground(flight, along + 0.02)
            assert np.mean((height > below - 0.02) & (height < above + 0.02)) > 0.995
            on_treads = below == above
            assert np.mean(np.abs(height - below)[on_treads] < 0.02) > 0.995
            checked += int(on_treads.sum())
        assert checked > 3000


def test_depth_is_what_rays_find(equal: SimSource) -> None:
    assert agreement(equal, (0, 200, 400)) > 0.95  # some lie on an edge


def test_one_step_up_looks_the_same(equal: SimSource) -> None:
    renderer, _ = equal._opened()
    flight = Flight.of(2)
    here = equal.pose(0)
    there = here.copy()
    there[:3, 3] += (flight.tread, 0.0, flight.riser)
    y, x = np.mgrid[:120, :160]
    rays = np.stack([(x - 79.5) / equal.camera.fx, (y - 59.5) / equal.camera.fy, np.ones(x.shape)])
    place = (rays * renderer.depth(here, {})).reshape(3, -1).T @ here[:3, :3].T + here[:3, 3]
    steps = (np.abs(place[:, 1]) < flight.width / 2 - 0.25) & (place[:, 0] > 0.05)
    steps &= place[:, 0] < (flight.steps - 2) * flight.tread
    pictures = [renderer.draw(pose, {}).pixels.astype(int) for pose in (here, there)]
    assert steps.sum() > 2000
    difference = np.abs(pictures[0] - pictures[1]).max(axis=2).ravel()
    assert np.percentile(difference[steps], 95) <= 1  # it may be rounded otherwise
    there[0, 3] += flight.tread / 2
    other = np.abs(pictures[0] - renderer.draw(there, {}).pixels).max(axis=2).ravel()
    assert np.median(other[steps]) > 2


def test_the_walk_goes_up_above_the_steps_and_comes_back(equal: SimSource) -> None:
    flight = Flight.of(2)
    _, poses = equal.truth()
    places = poses[:, :3, 3]
    assert np.all(places[:, 2] - ground(flight, places[:, 0]) > 1.2)
    assert np.all(np.abs(places[:, 1]) < flight.width / 2 - 0.3)
    assert np.ptp(places[:, 2]) > 0.8
    assert places[-1] == pytest.approx(places[0], abs=0.5)
