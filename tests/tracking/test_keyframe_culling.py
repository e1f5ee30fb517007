"""Which keyframe goes, and what goes with it: against plain counts over the observations."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from prism_edge.config import TrackingConfig
from prism_edge.messages import HOME
from prism_edge.tracking.keyframe_culling import (
    AT_ONCE,
    RECENT,
    cull_stand_in,
    culling,
    drop_keyframe,
    keeping_bound,
    take_out,
)
from prism_edge.tracking.local_map import LocalMap
from prism_edge.tracking.redundancy import bridged
from prism_edge.tracking.relocalisation import Relocaliser
from prism_edge.tracking.submaps import Parts
from tests.tracking.cloud import Cloud, check, counted, descriptors, observations, pose_at, walk

MANY = 1000


def references_hold(world: LocalMap) -> bool:
    """Every point's reference is a keyframe of the map that sees it at the keypoint named."""
    table = world.points
    return all(
        table.reference[row] in world.keyframes
        and world.keyframes[int(table.reference[row])].points[table.reference_keypoint[row]] == table.ids[row]
        for row in np.flatnonzero(table.alive)
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_best_bridged_goes_and_neither_the_first_nor_the_newest(seed):
    rng = np.random.default_rng(seed)
    world = walk(RECENT + 9, 0.05, seed)
    pairs = [(k, p) for p, keyframes in observations(world).items() for k in keyframes]
    dropped = np.array(pairs)[rng.random(len(pairs)) < 0.8]
    world.drop_observations(dropped[:, 0], dropped[:, 1])
    found = bridged(world)
    shares = {k: found[k] for k in range(1, 9)}
    expected = max(shares, key=lambda k: (shares[k], -k))
    assert len(set(shares.values())) > 4
    assert list(culling(world, RECENT + 8, MANY)) == [expected]
    assert set(world.keyframes) == set(range(RECENT + 9)) - {expected}
    assert world.changes.culled_keyframes == [expected]
    check(world)


def test_of_equals_the_oldest_goes_first():
    world, _ = Cloud().mapped([np.eye(4)] * 20)
    assert list(culling(world, 15, MANY)) == [1, 2, 3, 4, 5]
    check(world)


def test_the_first_stays_though_it_sees_nothing_any_more():
    world, cloud = LocalMap(), Cloud(50)
    for number in range(20):
        world.add_keyframe(cloud.keyframe(number, np.eye(4))[0])
    assert list(culling(world, 15, MANY)) == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("most", [10, 12, 13, 14, 25])
def test_the_bound_is_kept_whatever_it_is(most):
    world = walk(30)
    newest = sorted(world.keyframes)[-min(RECENT, most - 1) :]
    list(culling(world, most, MANY))
    assert len(world.keyframes) == most
    assert {0, *newest} <= set(world.keyframes)
    assert references_hold(world)
    check(world)


def test_a_map_within_its_bound_is_left_alone():
    world = walk(20)
    before = observations(world)
    assert list(culling(world, 20, MANY)) == []
    assert observations(world) == before
    assert not world.changes.culled_keyframes
    assert not world.changes.culled_points


def test_what_nobody_joins_goes_before_the_map_the_oldest_first():
    """People who stand before a robot give it parts of two keyframes and more, again and again."""
    world = walk(RECENT + 20, 0.05)
    parts = Parts.given({5: 5, 7: 7, 8: 7, 9: 9, 10: 9, 11: 9})
    parts.current = 9
    assert parts.small(1) == {5}
    assert parts.small(2) == {5, 7, 8}
    gone = culling(world, RECENT + 16, MANY, parts.small(2))
    assert [next(gone) for _ in range(3)] == [5, 7, 8]
    found = bridged(world)
    left = sorted(world.keyframes)[1:-RECENT]
    assert list(gone) == [max(left, key=lambda k: (found[k], -k))]
    check(world)


@pytest.mark.parametrize("count", [2, RECENT, RECENT + 1])
def test_a_part_that_is_no_small_one_is_not_given_up(count):
    parts = Parts.given(dict.fromkeys(range(3, 3 + count), 3))
    assert len(parts.small(RECENT)) == (count if count <= RECENT else 0)


@pytest.mark.parametrize(
    ("step", "most", "most_redundant"),
    [(0.3, 30, MANY), (0.15, 30, MANY), (0.3, 40, 25), (0.05, 60, 25)],
)
def test_a_map_of_a_long_way_stays_whole_and_takes_in_what_is_new(step, most, most_redundant):
    """Several times what it may hold: it becomes thinner everywhere, and breaks nowhere."""
    cloud, count = Cloud(10, seed=3), 150
    low, high = (-4.0, -2.0, 2.0), (count * step + 4.0, 2.0, 6.0)
    cloud.positions = cloud.rng.uniform(low, high, (max(int(60 * count * step), 1500), 3))
    cloud.descriptors = descriptors(cloud.rng, len(cloud.positions))
    world, ids = LocalMap(), np.full(len(cloud.positions), -1, np.int64)
    for number in range(count):
        keyframe, seen = cloud.keyframe(number, pose_at(step * number))
        there = ids[seen] >= 0
        there[there] = world.points.known(ids[seen][there])
        keyframe.points = np.where(there, ids[seen], -1)
        world.add_keyframe(keyframe)
        free = keyframe.free()
        sigmas = np.full(len(free), 0.01)
        ids[seen[free]] = world.add_points(keyframe, free, cloud.positions[seen[free]], sigmas, 5.0)
        keyframe.neighbours = [k.id for k in world.covisible(keyframe, most)]
        list(culling(world, most, most_redundant))
        world.points.squeeze()
    numbers = sorted(world.keyframes)
    assert len(numbers) <= most
    for one, other in pairwise(numbers):
        theirs = world.keyframes[other].points
        assert np.isin(theirs[theirs >= 0], world.keyframes[one].points).sum() >= 100
    assert max(b - a for a, b in pairwise(numbers)) <= 3 * count / (min(most, most_redundant) - RECENT)
    check(world)


def test_of_many_too_many_some_go_now_and_the_rest_with_later_keyframes():
    world = walk(40)
    assert len(list(culling(world, 15, MANY, at_once=4))) == 4
    assert len(world.keyframes) == 36
    assert len(list(culling(world, 15, MANY, at_once=4))) == 4
    assert len(list(culling(world, 15, MANY))) == 17


def test_beyond_the_number_all_redundant_neighbours_go_at_once():
    world = passed_again(RECENT + 12)
    assert len(list(culling(world, MANY, RECENT + 8, at_once=1))) == 4


def test_what_goes_is_forgotten_step_by_step():
    world = walk(40)
    parts, places = Parts.given({9: 9}), Relocaliser()
    for k in world.keyframes:
        places.add_place(k, np.eye(40, dtype=np.float32)[k])
    config = TrackingConfig(max_keyframes=20, redundant_keyframes=MANY)
    before, told = set(world.keyframes), []
    for _ in keeping_bound(world, parts, places, config):
        (now,) = before - set(world.keyframes) - set(told)
        told.append(now)
        assert now not in places.index
    assert told[:2] == [39 - RECENT, 9], "what stood in, and what is a part of its own"
    assert len(told) == 1 + AT_ONCE < 40 - 20
    assert parts.small(MANY) <= world.keyframes.keys()
    assert len(places.index) == len(world.keyframes)


def test_what_is_taken_out_is_forgotten_with_its_part_and_its_place():
    world, parts, places = walk(3), Parts(), Relocaliser()
    parts.begin(2)
    for k in world.keyframes:
        places.add_place(k, np.eye(3, dtype=np.float32)[k])
    take_out(world, parts, places, world.keyframes[2])
    assert set(world.keyframes) == {0, 1}
    assert parts.of(2) == HOME
    assert [k in places.index for k in range(3)] == [True, True, False]
    check(world)


def passed_again(count: int) -> LocalMap:
    """A camera that goes to and fro before one wall; the newest keyframe knows its neighbours."""
    path = [pose_at(0.05 * (i % 4), 0.0, 0.0, 0.0, 0.0) for i in range(count)]
    world, _ = Cloud(400).mapped(path)
    newest = world.newest()
    newest.neighbours = [k.id for k in world.covisible(newest, count)]
    return world


def test_beyond_a_number_the_redundant_go_and_what_placed_the_room_stays():
    world = passed_again(RECENT + 12)
    assert counted(world, 5) > 0.9
    assert list(culling(world, MANY, RECENT + 8)) == [11, 10, 9, 8]
    check(world)


def test_up_to_that_number_only_the_bound_costs_keyframes_the_oldest_of_equals_first():
    world = passed_again(RECENT + 12)
    assert list(culling(world, RECENT + 10, RECENT + 12)) == [4, 5], "those before them saw some points first"
    check(world)


def test_beyond_it_what_is_not_redundant_stays():
    world = walk(RECENT + 12, 0.3)
    world.newest().neighbours = list(range(12))
    wanted = {k for k in range(1, 12) if counted(world, k) > 0.9}
    assert 0 < len(wanted) < 11
    gone = list(culling(world, MANY, 10))
    assert gone
    assert set(gone) <= wanted
    check(world)


def test_beyond_it_what_is_elsewhere_stays():
    world = passed_again(RECENT + 12)
    world.newest().neighbours = [3, 6]
    assert list(culling(world, MANY, 10)) == [6, 3]
    check(world)


def test_points_that_fewer_than_two_still_see_go_with_it():
    world = walk(12, 0.3)
    before = observations(world)
    drop_keyframe(world, world.keyframes[0])
    lonely = {p for p, seen in before.items() if 0 in seen and len(seen) < 3}
    assert len(lonely) > 10
    gone = np.concatenate(world.changes.culled_points).tolist()
    assert sorted(gone) == sorted(lonely)
    assert not lonely & set(observations(world))
    untouched = {p: seen for p, seen in before.items() if 0 not in seen}
    assert untouched.items() <= observations(world).items(), "a point seen once elsewhere is not its affair"
    check(world)


def test_its_points_get_the_oldest_that_sees_them_as_reference():
    world = walk(12, 0.15)
    table = world.points
    assert references_hold(world)
    before = dict(zip(table.ids.tolist(), table.reference.tolist(), strict=True))
    drop_keyframe(world, world.keyframes[0])
    assert references_hold(world)
    seen = observations(world)
    handed_on = [p for p in table.ids[table.alive].tolist() if before[p] == 0]
    assert len(handed_on) > 50
    for p in table.ids[table.alive].tolist():
        expected = min(seen[p]) if before[p] == 0 else before[p]
        assert table.reference[table.rows(np.array([p]))[0]] == expected


def test_points_of_other_keyframes_keep_the_reference_that_they_have():
    """Who saw a point first may not be the oldest that sees it: older ones learn of it later."""
    world = walk(12, 0.15)
    table, seen = world.points, observations(world)
    late = [p for p, views in seen.items() if 0 not in views and len(views) > 3]
    rows = table.rows(np.array(late))
    table.reference[rows] = [max(seen[p]) for p in late]
    table.reference_keypoint[rows] = [seen[p][max(seen[p])] for p in late]
    drop_keyframe(world, world.keyframes[0])
    assert len(late) > 20
    assert table.reference[table.rows(np.array(late))].tolist() == [max(seen[p]) for p in late]
    assert references_hold(world)


PLACES, NEWEST = 6, [pose_at(-0.6, -0.02 * i) for i in range(RECENT)]


def visited_again(place: int, motion: np.ndarray | None = None) -> LocalMap:
    """A map of some places, one of them seen again, and of the newest keyframes, which are elsewhere."""
    there = [pose_at(0.2 * i, 0.0, 0.0, 0.0, -0.04 * i) for i in range(PLACES)]
    again = there[place] @ (np.eye(4) if motion is None else motion)
    world, _ = Cloud(600).mapped([*there, again, *NEWEST])
    return world


@pytest.mark.parametrize("place", range(PLACES))
def test_what_stood_in_for_a_keyframe_of_the_same_place_goes(place):
    world = visited_again(place, pose_at(0.03, 0.02, 0.0, 0.0, 0.02))
    assert counted(world, PLACES) > 0.9
    assert cull_stand_in(world) == [PLACES]
    assert world.changes.culled_keyframes == [PLACES]
    assert references_hold(world)
    check(world)
    assert cull_stand_in(world) == []  # the next in age is what it stood in for


def test_a_place_of_its_own_stays_however_redundant():
    world = visited_again(2, pose_at(0.1, 0.2))
    assert counted(world, PLACES) > 0.9
    assert cull_stand_in(world) == []


def test_what_others_do_not_see_as_well_keeps_its_keyframe():
    world = visited_again(2)
    others = world.keyframes[2].points
    seen = [(k, p) for p, views in observations(world).items() for k in views if p in others and k > PLACES]
    dropped = np.array(seen)
    world.drop_observations(dropped[:, 0], dropped[:, 1])
    for k in (0, 1, 4, 5):
        gone = np.array([p for p, views in observations(world).items() if k in views and p in others])
        world.drop_observations(np.full(len(gone), k), gone)
    assert counted(world, PLACES) < 0.9
    assert cull_stand_in(world) == []


@pytest.mark.parametrize("count", [1, RECENT, RECENT + 1])
def test_a_young_map_loses_none(count):
    world, _ = Cloud().mapped([np.eye(4)] * count)
    assert cull_stand_in(world) == []
