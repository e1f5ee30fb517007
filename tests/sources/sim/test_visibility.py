"""Drawing order and clipping, against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.sources.sim.visibility import NEAR, body_order, clipped


def entries(low: np.ndarray, high: np.ndarray, centre: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """How far along a ray it enters each box; inf where it misses."""
    with np.errstate(divide="ignore"):
        a, b = (low - centre) / ray, (high - centre) / ray
    into, out = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return np.where((into < out) & (into > 0), into, np.inf)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_nothing_is_drawn_before_what_it_hides(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.permutation(4 * 4 * 4)[:14]
    corner = np.stack(np.unravel_index(cells, (4, 4, 4)), axis=1).astype(float)
    low = corner + rng.uniform(0.0, 0.3, corner.shape)
    high = corner + rng.uniform(0.6, 1.0, corner.shape)
    centre = rng.uniform(-1, 5, 3)
    rank = np.empty(14, dtype=int)
    order = body_order(low, high, centre)
    assert sorted(order) == list(range(14))
    rank[order] = np.arange(14)
    for ray in rng.normal(size=(200, 3)):
        distance = entries(low, high, centre, ray)
        hit = np.flatnonzero(np.isfinite(distance))
        near_to_far = hit[np.argsort(distance[hit])]
        assert np.all(np.diff(rank[near_to_far]) < 0)


def test_overlapping_boxes_go_by_distance() -> None:
    low, high = np.zeros((2, 3)), np.ones((2, 3))
    low[1, 0], high[1, 0] = 0.5, 1.5
    assert body_order(low, high, np.array([-2.0, 0.5, 0.5])).tolist() == [1, 0]
    assert body_order(low, high, np.array([4.0, 0.5, 0.5])).tolist() == [0, 1]


def test_no_boxes() -> None:
    assert len(body_order(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(3))) == 0


def test_clipping_keeps_what_is_before_the_camera() -> None:
    # a floor 1 m below the camera, from 1 m behind to 3 m ahead (x z, y z, z of a unit camera)
    floor = np.array([[-1.0, 1, -1], [1, 1, -1], [1, 1, 3], [-1, 1, 3]])
    pixels = clipped(floor)
    assert len(pixels) == 4
    assert pixels[:, 1].min() == pytest.approx(1 / 3)
    assert pixels[:, 1].max() == pytest.approx(1 / NEAR)
    assert len(clipped(floor * (1, 1, -1) - (0, 0, 3))) == 0
