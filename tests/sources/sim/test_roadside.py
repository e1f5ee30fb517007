"""Fronts of houses and what stands before them, on a wall whose length is known."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.sources.sim import roadside
from prism_edge.sources.sim.shell import Wall
from prism_edge.sources.sim.surfaces import UP, Shop

LENGTH, HEIGHT = 43.7, 16.0
# A wall along y that faces -x.
START, ALONG = np.array([5.0, 2.0 + LENGTH, 0.0]), np.array([0.0, -1.0, 0.0])  # from the left, as it is seen
WALL = Wall(START, ALONG, np.array([-1.0, 0.0, 0.0]), LENGTH, [])


@pytest.mark.parametrize("seed", range(5))
def test_fronts_and_sky_cover_a_wall_once(seed: int) -> None:
    shop = Shop(np.random.default_rng(seed), [])
    roadside.line_up(shop, WALL, HEIGHT)
    made = shop.done()
    area = np.linalg.norm(np.cross(made.right, made.down), axis=1)
    assert area.sum() == pytest.approx(LENGTH * HEIGHT)
    corners = np.stack([made.origin, made.origin + made.right + made.down])
    assert corners[:, :, 0] == pytest.approx(5.0)
    assert (corners[:, :, 1].min(), corners[:, :, 1].max()) == pytest.approx((2.0, 2.0 + LENGTH))
    assert (corners[:, :, 2].min(), corners[:, :, 2].max()) == pytest.approx((0.0, HEIGHT))
    towards = made.normal / np.linalg.norm(made.normal, axis=1, keepdims=True)
    assert towards == pytest.approx(np.tile(WALL.normal, (len(towards), 1)), abs=1e-9)
    # No point of the wall is on two of them.
    rng = np.random.default_rng(0)
    for y, z in rng.uniform((2.0, 0.0), (2.0 + LENGTH, HEIGHT), (200, 2)):
        a, b = np.minimum(*corners)[:, 1:], np.maximum(*corners)[:, 1:]
        assert np.all((a < (y, z)) & ((y, z) < b), axis=1).sum() == 1


@pytest.mark.parametrize("seed", range(5))
def test_things_stand_before_the_wall_one_beside_the_other(seed: int) -> None:
    shop = Shop(np.random.default_rng(seed), [])
    roadside.park(shop, WALL)
    made = shop.done()
    assert len(made.body_low) >= 4
    assert made.body_low[:, 0].min() >= 5.0 - roadside.DEEPEST
    assert made.body_high[:, 0].max() <= 5.0
    assert made.body_low[:, 1].min() >= 2.0
    assert made.body_high[:, 1].max() <= 2.0 + LENGTH
    order = np.argsort(made.body_low[:, 1])
    assert np.all(made.body_low[order][1:, 1] - made.body_high[order][:-1, 1] > 0.9)
    upwards = made.normal @ UP > 1e-9
    assert upwards.sum() == len(made.body_low)  # each has a top, and none a bottom to be seen


@pytest.mark.parametrize("paint", [roadside.asphalt, roadside.leaves])
def test_roads_and_hedges_have_texture_at_several_scales_and_the_sky_has_none(paint) -> None:
    image, blank = (p(np.random.default_rng(0), 300, 400).mean(axis=2) for p in (paint, roadside.sky))
    for size in (1, 4, 16):
        means = image[:288, :384].reshape(288 // size, size, 384 // size, size).mean(axis=(1, 3))
        assert means.std() > 1.5
    assert blank.std() < 1.5
    assert blank.mean() > 200
