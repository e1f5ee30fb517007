"""What hangs together: small maps whose parts are plain, and random ones against the closure of "shares"."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.backend.connectivity import (
    BEST_FEW,
    FEW_SHARED,
    LOOPED,
    MANY_SHARED,
    covisibility,
    hanging_together,
    joined_pieces,
    own_way,
    parts_of,
    reachable,
    shared_points,
    ways,
    with_bridges,
)
from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap, GlobalPoint
from prism_edge.messages import HOME
from prism_edge.tracking.local_map import LEAST_SHARED
from tests.backend.world import chain
from tests.tracking.cloud import CAMERA, pose_at


def two_chains() -> GlobalMap:
    world = chain([pose_at(0.3 * i) for i in range(6)])
    return chain([pose_at(50.0 + 0.3 * i) for i in range(3)], first=100, world=world)


def seen_by(sets: list[set[int]]) -> GlobalMap:
    """A map of keyframes 0, 1, ... that see these points."""
    world = GlobalMap()
    for k, points in enumerate(sets):
        empty = np.zeros((len(points), 2))
        world.keyframes[k] = GlobalKeyframe(k, k, CAMERA, np.eye(4), empty, np.ones(len(points)), {})
        for keypoint, p in enumerate(sorted(points)):
            world.points.setdefault(p, GlobalPoint(np.array([0.0, 0.0, 3.0])))
            world.observe(k, p, keypoint)
    return world


@settings(max_examples=200, deadline=None)
@given(st.lists(st.sets(st.integers(0, 25), max_size=4), min_size=1, max_size=12))
def test_what_any_shared_point_joins(sets: list[set[int]]) -> None:
    count = len(sets)
    joined = np.array([[i == j or bool(sets[i] & sets[j]) for j in range(count)] for i in range(count)])
    closure = np.linalg.matrix_power(joined.astype(np.int64), count) > 0
    world = seen_by(sets)
    for k in range(count):
        assert hanging_together(world, k) == set(np.flatnonzero(closure[k]).tolist())
    first = closure.argmax(axis=1)
    assert parts_of(world) == {k: int(first[k]) for k in range(count) if not closure[k, 0]}


@settings(max_examples=100, deadline=None)
@given(st.lists(st.sets(st.integers(0, 25), max_size=20), min_size=1, max_size=8))
def test_how_many_points_each_two_share(sets: list[set[int]]) -> None:
    told = [column.tolist() for column in shared_points(seen_by(sets))]
    both = {(i, j): len(sets[i] & sets[j]) for j in range(len(sets)) for i in range(j) if sets[i] & sets[j]}
    assert {(a, b): count for a, b, count in zip(*told, strict=True)} == both


def test_points_that_hundreds_see_are_counted_in_bounded_memory() -> None:
    world = seen_by([set(range(200))] * 200)  # 4 million pairs of 8 bytes, and what sorting them takes
    tracemalloc.start()
    try:
        _, _, shared = shared_points(world)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert shared.tolist() == [200] * (200 * 199 // 2)
    assert peak < 80e6


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.integers(2, 12))
def test_tied_are_all_that_share_many_points_and_the_best_few(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    seen = [rng.random(150) < rng.uniform(0.2, 0.9) for _ in range(count)]
    world = seen_by([set(np.flatnonzero(row).tolist()) for row in seen])
    expected = {}
    for k in range(count):
        before = [(other, shared) for other, shared in world.covisible(k) if other < k]
        for rank, (other, shared) in enumerate(before):
            if shared >= MANY_SHARED or (rank < BEST_FEW and shared >= FEW_SHARED):
                expected[other, k] = shared
    assert list(covisibility(world, []).items()) == list(expected.items())


def test_neighbours_share_more_than_chance_would() -> None:
    mine = set(range(100))
    shared = (LEAST_SHARED, LEAST_SHARED - 1, 40, 0)
    world = seen_by([mine, *({*range(n), 1000 + k} for k, n in enumerate(shared))])
    assert world.neighbours(0) == [3, 1]


def test_a_loop_ties_what_shares_nothing() -> None:
    world = two_chains()
    assert reachable(covisibility(world, []), {0}) == set(range(6))
    assert reachable(covisibility(world, [(3, 101)]), {0}) == set(range(6)) | {100, 101, 102}
    assert joined_pieces(world, [(3, 101)]) == [set(range(6)) | {100, 101, 102}]
    assert joined_pieces(world, [(3, 7)]) == [set(range(6)), {100, 101, 102}]  # with one that has gone: none


def test_a_loop_whose_either_end_was_culled_ties_nothing() -> None:
    world = two_chains()
    tied = covisibility(world, [(0, 999), (999, 0), (102, 5)])
    assert all({a, b} <= world.keyframes.keys() for a, b in tied)
    assert tied[5, 102] == LOOPED, "the older first, whichever looked"
    assert 102 in ways(world, tied, 0)


def test_a_chance_match_ties_nothing() -> None:
    """A few points that both parts see by mistake make them no one map, though they hang together."""
    world = two_chains()
    for keypoint, p in enumerate(sorted(world.keyframes[5].observed)[: FEW_SHARED - 1]):
        world.observe(100, p, keypoint)
    assert reachable(covisibility(world, []), {0}) == set(range(6))
    assert [min(part) for part in joined_pieces(world, [])] == [0, 100]
    assert parts_of(world) == {}


def test_the_way_is_the_shortest_by_strong_ties() -> None:
    world = two_chains()
    found = ways(world, covisibility(world, []), 1)
    lengths = {k: way.length for k, way in found.items()}
    assert lengths == pytest.approx({k: 0.3 * abs(k - 1) for k in range(6)})
    world.keyframes[3].world_from_camera[:3, 3] = (0.9, 40.0, 0.0)  # all go round by it
    assert ways(world, covisibility(world, []), 5)[1].length > 79.0
    assert ways(world, covisibility(world, [(1, 5)]), 5)[1].length == pytest.approx(1.2)
    assert 100 not in ways(world, covisibility(world, []), 0)
    weak = dict.fromkeys(covisibility(world, []), LOOPED - 1)
    assert ways(world, weak, 0) == {0: (0.0, 0.0)}


def test_a_way_turns_by_all_its_turns() -> None:
    """There and back, too."""
    poses = [pose_at(0.1 * i, 0.0, 0.0, 0.0, 0.1 * (i % 2)) for i in range(6)]
    world = chain(poses)
    for k, keyframe in world.keyframes.items():
        keyframe.travelled = 2.0 * k
    along = {(k, k + 1): LOOPED for k in range(5)}
    assert ways(world, along, 0)[5] == pytest.approx((0.5, 0.5), rel=0.01)
    assert own_way(world, 5, 1) == pytest.approx((8.0, 0.4))
    assert own_way(world, 1, 3) == pytest.approx((4.0, 0.2)), "whatever has come since"


def test_a_part_ends_where_points_are_fused_with_the_first_ones() -> None:
    world = two_chains()
    assert parts_of(world) == {100: 100, 101: 100, 102: 100}
    world.fuse(min(world.keyframes[100].observed), 0)  # a loop joins them
    assert parts_of(world) == {}


def test_a_loop_does_not_weaken_a_tie_that_is_stronger() -> None:
    world = chain([pose_at(0.3 * i) for i in range(3)])
    assert covisibility(world, [(2, 1)])[1, 2] == covisibility(world, [])[1, 2] > LOOPED


def test_what_the_tracker_has_at_home_is_at_home() -> None:
    """Culling, or a keyframe that was lost on its way, may leave no point that says so."""
    world = two_chains()
    for keyframe in world.keyframes.values():
        keyframe.part = HOME
    assert parts_of(world) == {}
    for k in (100, 101, 102):
        world.keyframes[k].part = 90  # its first, which has been culled since
    assert parts_of(world) == {100: 90, 101: 90, 102: 90}
    world.keyframes[101].part = HOME  # made once a loop had joined them
    assert parts_of(world) == {}
    for k in (100, 102):
        world.keyframes[k].part = None
    world.keyframes[101].part = 90
    assert parts_of(world) == {100: 90, 101: 90, 102: 90}


@pytest.mark.parametrize("newer", [HOME, 90, None])
def test_a_bridge_leads_where_the_camera_was_followed(newer: int | None) -> None:
    """Within one part of the map alone, and one for each break: from the last before to the first after."""
    world = two_chains()
    for k, keyframe in world.keyframes.items():
        keyframe.part = newer if k >= 100 else HOME
    by = covisibility(world, [])
    bridged = with_bridges(world, by)
    assert bridged.items() - by.items() == ({((5, 100), LOOPED)} if newer == HOME else set())
    assert by.items() <= bridged.items()


def test_no_bridge_where_ties_lead_another_way() -> None:
    """A part that a loop tied to the middle of the other, and a piece between them that nothing ties."""
    world = two_chains()
    chain([pose_at(80.0 + 0.3 * i) for i in range(2)], first=50, world=world)
    for keyframe in world.keyframes.values():
        keyframe.part = HOME
    by = covisibility(world, [(100, 2)])
    assert with_bridges(world, by).keys() - by.keys() == {(5, 50)}
