"""Keypoints spread over an image: against a plain loop, and what crowds may keep."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.tracking.spreading import CELL, CROWD, ENOUGH, spread

SHAPE = (480, 640)
CELLS = (SHAPE[0] // CELL + 1) * (SHAPE[1] // CELL + 1)


def cell_of(pixels: np.ndarray) -> np.ndarray:
    return (pixels // CELL).astype(int) @ (1, 1000)


def anywhere(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform((0, 0), (SHAPE[1], SHAPE[0]), (count, 2)).astype(np.float32)


def by_a_plain_loop(pixels, strength, wanted, least):
    """Deal out of every cell in turn, the strongest first."""
    cells: dict[int, list[int]] = {}
    for i in np.argsort(-strength):
        cells.setdefault(int(cell_of(pixels[i : i + 1])[0]), []).append(int(i))
    dealt, most = [], CROWD * wanted / CELLS
    for rank in range(max(map(len, cells.values()))):
        turn = sorted((c[rank] for c in cells.values() if len(c) > rank), key=lambda i: -strength[i])
        if rank >= most:
            turn = turn[: max(int(ENOUGH * least) - len(dealt), 0)]
        dealt += turn
    return dealt[:wanted]


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1), st.integers(1, 1500), st.integers(1, 900), st.floats(0, 1), st.floats(0.05, 1)
)
def test_it_deals_as_a_plain_loop_does(seed, count, wanted, share, extent):
    rng = np.random.default_rng(seed)
    pixels = anywhere(rng, count) * np.float32(extent)
    strength = rng.permutation(count).astype(float)
    least = int(share * wanted)
    chosen = spread(pixels, strength, SHAPE, wanted, least)
    assert chosen.tolist() == by_a_plain_loop(pixels, strength, wanted, least)


def test_nobody_gets_a_second_before_everybody_has_a_first():
    rng = np.random.default_rng(3)
    pixels, strength = anywhere(rng, 2000), rng.permutation(2000).astype(float)
    chosen = spread(pixels, strength, SHAPE, 100, 100)
    assert len(np.unique(cell_of(pixels[chosen]))) == len(chosen) == 100


def test_one_textured_thing_does_not_take_most_of_a_bare_room():
    rng = np.random.default_rng(1)
    thing = rng.uniform(200, 290, (500, 2)).astype(np.float32)
    wall = anywhere(rng, 250)
    pixels, strength = np.concatenate([thing, wall]), np.concatenate([np.full(500, 90.0), np.full(250, 20.0)])
    chosen = spread(pixels, strength, SHAPE, 1400, 500)
    on_thing = int((chosen < 500).sum())
    assert on_thing <= CROWD * 1400 / CELLS * 16  # the cells that it touches
    assert on_thing < len(chosen) / 2
    assert (chosen >= 500).sum() >= 0.9 * 250


def test_where_there_is_nothing_else_a_crowd_is_kept():
    rng = np.random.default_rng(2)
    pixels, strength = rng.uniform(194, 222, (600, 2)).astype(np.float32), rng.permutation(600).astype(float)
    chosen = spread(pixels, strength, SHAPE, 700, 500)
    assert len(chosen) == ENOUGH * 500
    assert strength[chosen].mean() > strength.mean() + 100  # the strongest of them


@pytest.mark.parametrize("wanted", [0, 10])
def test_no_keypoints_none_chosen(wanted):
    assert len(spread(np.zeros((0, 2), np.float32), np.zeros(0), SHAPE, wanted, wanted)) == 0
