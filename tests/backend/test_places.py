"""Which keyframes are looked at for a loop."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from prism_edge.backend.global_map import LONG_AGO, GlobalMap
from prism_edge.backend.places import (
    FEW_SHARED,
    RECENT,
    RECENT_S,
    SOME_SHARED,
    candidates,
    half_known,
)
from prism_edge.config_file import leaves
from prism_edge.tracking.place_index import PlaceIndex
from tests.backend.ring import Ring
from tests.backend.world import SHARED, chain
from tests.tracking.cloud import pose_at


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


@pytest.mark.parametrize("clock_s", [0.0, 1e6, -1e6], ids=["on", "fast", "slow"])
def test_what_was_seen_a_moment_ago_is_no_place_before(walked, clock_s):
    """Many keyframes in little time: a thing that has moved on looks as it did. However the clock is set."""
    world, index = copy.deepcopy(walked)
    for k, keyframe in world.keyframes.items():
        keyframe.stamp_ns = int(1e9 * (0.1 * k + (clock_s if k >= 10 else 0.0)))
    found = candidates(world, index, 41, 100)
    assert found
    for k in found:
        assert abs(world.keyframes[41].stamp_ns - world.keyframes[k].stamp_ns) >= 1e9 * RECENT_S
        assert k <= 41 - 10 * RECENT_S
    for keyframe in world.keyframes.values():
        keyframe.stamp_ns = 0
    assert candidates(world, index, 41, 100) == []
    for earlier_run in (LONG_AGO, -LONG_AGO):  # the clock was set back since, or counts from zero now
        world.keyframes[3].stamp_ns = earlier_run
        assert candidates(world, index, 41, 100) == [3]


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


def recognised(walked, at: dict[int, int]) -> GlobalMap:
    """Keyframe 41, in which the tracker has found so many points of each of some others again."""
    world = copy.deepcopy(walked[0])
    mine = iter(sorted(world.keyframes[41].observed))
    for keyframe, count in at.items():
        for point in sorted(world.keyframes[keyframe].observed)[:count]:
            world.fuse(next(mine), point)
    return world


def test_of_places_half_known_the_nearest_view_comes_first_not_that_with_most_points(walked):
    world = recognised(walked, {0: SOME_SHARED, 20: 8})
    shared = dict(world.covisible(41))
    chosen = half_known(world, 41, 100, ())
    assert chosen[0] == 1, "where it is again, a round later"
    assert any(15 <= k <= 25 and shared[k] > shared[chosen[0]] for k in chosen[1:])
    assert all(SOME_SHARED <= shared[k] < FEW_SHARED for k in chosen)
    assert half_known(world, 41, 1, ()) == chosen[:1]
    assert chosen[0] not in half_known(world, 41, 100, without=chosen[:1])


def test_near_is_what_is_moved_little_for_how_far_the_points_are():
    """All of them 3 units away: 0.45 aside are less than a turn by 0.2, and more in a room of a tenth."""
    aside, turned, elsewhere = pose_at(0.45), pose_at(0, 0, 0, 0, 0.2), pose_at(100.0)
    last = RECENT + 4
    world = chain([aside, elsewhere, turned, *[elsewhere] * (RECENT + 1), pose_at()])
    for k, keyframe in world.keyframes.items():
        keyframe.stamp_ns = int(1e9 * RECENT_S) * k
    for keypoint, p in enumerate([*range(SOME_SHARED), *range(3 * SHARED, 3 * SHARED + SOME_SHARED)]):
        world.points[p].position = np.array([0.0, 0.0, 3.0])
        world.observe(last, p, keypoint)
    assert half_known(world, last, 100, ()) == [0, 2]


def test_a_place_of_which_next_to_nothing_was_found_again_is_not_half_known(walked):
    world, _ = walked
    assert half_known(world, 41, 100, ()) == []
    assert half_known(recognised(walked, {0: SOME_SHARED - 1}), 41, 100, ()) == []
    assert half_known(world, 12345, 5, ()) == []


def test_neither_the_latest_nor_what_shares_many_points_is_half_known(walked):
    for query in range(44):
        assert half_known(walked[0], query, 100, ()) == []  # each shares points with those just before it
    world = recognised(walked, {0: FEW_SHARED})
    assert dict(world.covisible(41))[0] == FEW_SHARED
    assert 0 not in half_known(world, 41, 100, ())
    world = recognised(walked, {0: SOME_SHARED})
    for keyframe in world.keyframes.values():
        keyframe.stamp_ns = world.keyframes[41].stamp_ns - int(1e9 * RECENT_S) + 1
    assert half_known(world, 41, 100, ()) == []


def test_the_settings_say_of_how_few_keyframes_none_closes_a_loop():
    (bound,) = (leaf for leaf in leaves() if leaf.key == "tracking.max_keyframes")
    assert f"fewer than {RECENT + 2} close no loop" in bound.help  # the query, the latest, and one before
