"""Which keyframes are looked at for a loop."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.places import FEW_SHARED, RECENT, candidates
from prism_edge.tracking.place_index import PlaceIndex
from tests.backend.ring import Ring


@pytest.fixture(scope="module")
def walked() -> tuple[GlobalMap, PlaceIndex]:
    ring, world, index = Ring(), GlobalMap(), PlaceIndex()
    for message in ring.keyframes(44):
        world.absorb(message)
        index.add(message.id, ring.looks_like(message.id))
    return world, index


def test_a_return_finds_the_beginning(walked):
    world, index = walked
    chosen = candidates(world, index, 41, 3)
    assert chosen[0] == 1
    assert candidates(world, index, 41, 1) == [1]


def test_neither_the_latest_nor_what_shares_points_is_a_place_before(walked):
    world, index = walked
    for query in range(44):
        shared = dict(world.covisible(query))
        for k in candidates(world, index, query, 100):
            assert k < query - RECENT
            assert shared.get(k, 0) < FEW_SHARED
    assert candidates(world, index, RECENT, 100) == []


def test_one_keyframe_stands_for_its_place(walked):
    world, index = walked
    chosen = candidates(world, index, 41, 100)
    for i, k in enumerate(chosen):
        shared = dict(world.covisible(k))
        assert all(shared.get(other, 0) < 60 for other in chosen[:i])


def test_those_left_out_are_left_out(walked):
    world, index = walked
    assert not {0, 1, 2} & set(candidates(world, index, 41, 100, without={0, 1, 2}))


def test_a_keyframe_without_a_descriptor_has_none(walked):
    world, _ = walked
    index = PlaceIndex()
    index.add(1, np.ones(4, np.float32))
    assert candidates(world, index, 41, 5) == []
    assert candidates(world, index, 12345, 5) == []
