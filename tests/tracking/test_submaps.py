"""Parts of a map: what belongs to which, and how they become one."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.tracking.submaps import HOME, Parts
from tests.tracking.cloud import Cloud, pose_at


def test_everything_is_at_home_until_a_part_begins():
    parts = Parts()
    parts.add(3)
    assert parts.at_home
    assert parts.of(3) == HOME
    parts.begin(7)
    parts.add(8)
    assert not parts.at_home
    assert [parts.of(k) for k in (3, 7, 8)] == [HOME, 7, 7]


def test_merging_keeps_the_older_part():
    parts = Parts()
    parts.begin(10)
    parts.add(11)
    parts.begin(20)
    parts.add(21)
    assert parts.merge(21, 11)
    assert [parts.of(k) for k in (10, 20, 21)] == [10, 10, 10]
    assert parts.current == 10
    assert not parts.merge(20, 10), "they are one"
    assert parts.merge(2, 20)
    assert parts.at_home
    assert all(parts.of(k) == HOME for k in (2, 10, 11, 20, 21))


def test_what_joined_is_told_once_where_the_units_are_known():
    parts = Parts()
    parts.begin(10)
    assert parts.merge(10, 2, np.zeros(0))
    assert parts.take_joined() == []
    parts.begin(20)
    assert parts.merge(2, 20, np.array([0.1, 0.01]))
    assert parts.take_joined() == [(20, HOME, 0.1, 0.01)]
    assert parts.take_joined() == []


def test_merging_two_parts_that_the_camera_is_not_in():
    parts = Parts()
    parts.begin(10)
    parts.begin(20)
    parts.begin(30)
    parts.merge(10, 20)
    assert parts.current == 30
    assert parts.of(20) == 10


def test_the_camera_is_in_the_part_whose_points_it_sees():
    cloud = Cloud(400, seed=0)
    world, _ = cloud.mapped([pose_at(0.2 * i) for i in range(6)])
    parts = Parts()
    parts.begin(4)
    parts.add(5)
    assert parts.newest(world).id == 5
    assert parts.size(world) == 2
    only_first = world.keyframes[0].points[:1]
    for k in (3, 4, 5):
        world.keyframes[k].points[np.isin(world.keyframes[k].points, only_first)] = -1
    parts.enter(world, only_first)
    assert parts.at_home
    assert parts.newest(world).id == 3
    parts.enter(world, np.zeros(0, np.int64))
    assert parts.at_home, "nothing seen says nothing"


def test_what_has_left_the_map_is_forgotten():
    cloud = Cloud(100, seed=0)
    world, _ = cloud.mapped([pose_at(0.2 * i) for i in range(3)])
    parts = Parts()
    parts.begin(2)
    del world.keyframes[2]
    parts.forget(2)
    assert parts.of(2) == HOME
    assert parts.newest(world).id == 1, "of the map, where the part has none left"


def test_a_loop_of_a_keyframe_that_has_just_left_the_map_joins_its_part():
    parts = Parts()
    for first in (60, 70):
        parts.begin(first)
        parts.add(first + 1)
        parts.forget(first + 1)
    assert parts.merge(61, 3, np.array([0.1, 0.01]))
    assert (parts.of(60), parts.of(70), parts.at_home) == (HOME, 70, False)
    assert parts.take_joined() == [(60, HOME, 0.1, 0.01)]
    assert not parts.merge(61, 3), "it is at home by now"


def test_a_part_of_one_keyframe_is_a_small_one_unless_the_camera_is_there():
    parts = Parts.given({3: 3, 5: 5, 6: 5})
    assert parts.small(1) == {3}
    parts.begin(9)
    assert parts.small(1) == {3}
    parts.begin(12)
    assert parts.small(1) == {3, 9}
    parts.merge(12, 9)
    assert parts.small(1) == {3}


def test_the_newest_and_the_number_are_those_of_a_plain_search():
    world, _ = Cloud(60, seed=0).mapped([pose_at(0.02 * i) for i in range(9)])
    for of in ({}, {3: 3, 4: 3}, {3: 3, 7: 7, 8: 7}, {0: 5}, {20: 20}):
        for current in (HOME, 3, 7, 20):
            parts = Parts.given(of)
            parts.current = current
            mine = [k for k in world.keyframes if parts.of(k) == current]
            assert parts.size(world) == len(mine)
            assert parts.newest(world).id == (max(mine) if mine else 8)


def test_a_loop_may_come_of_a_culled_part_however_much_of_home_has_gone_since():
    parts = Parts()
    parts.begin(10)
    parts.add(11)
    parts.forget(11)
    parts.current = HOME
    for other in range(100, 1000):
        parts.forget(other)
    assert parts.merge(11, 2)
    assert parts.of(10) == HOME


@pytest.mark.parametrize("home", [True, False])
def test_where_two_parts_know_the_points_the_camera_is_in_the_one_that_sees_most_of_them(home):
    world, _ = Cloud(400, seed=0).mapped([pose_at(0.2 * i) for i in range(4)])
    parts = Parts.given({2: 2, 3: 2})
    few = world.keyframes[1 if home else 2].points[:60]
    for k in (0, 1) if not home else (2, 3):  # of the other part none sees more than the last ten of them
        points = world.keyframes[k].points
        points[np.isin(points, few[:50])] = -1
    assert {parts.of(k) for k in world.votes(few)} == {HOME, 2}
    parts.enter(world, few)
    assert parts.current == (HOME if home else 2)


@pytest.mark.parametrize(("since", "known"), [(255, True), (256, False)])
def test_of_culled_keyframes_the_last_256_still_say_which_part_a_loop_joins(since, known):
    parts, culled = Parts(), list(range(11, 11 + 1 + since))
    parts.begin(10)
    for keyframe in culled:
        parts.add(keyframe)
    for keyframe in culled:
        parts.forget(keyframe)
    assert parts.of_both(11, 2) == (HOME, 10 if known else HOME)
    assert parts.of_both(12, 2) == (HOME, 10), "one goes at a time"


def test_what_several_keyframes_of_a_part_see_together_counts_for_it():
    world, _ = Cloud(400, seed=0).mapped([pose_at(0.1 * i) for i in range(4)])
    seen = world.keyframes[0].points.copy()
    few = np.array([p for p in seen if all(p in k.points for k in world.keyframes.values())])[:60]
    shares = few[:25], few[25:50], few[50:], few[:40]
    for keyframe, mine in zip(world.keyframes.values(), shares, strict=True):
        keyframe.points[np.isin(keyframe.points, np.setdiff1d(few, mine))] = -1
    parts = Parts.given({3: 3})  # which sees 40 of them, more than any one of home's, whose three see 60
    parts.current = 3
    parts.enter(world, few)
    assert parts.at_home


def test_a_part_that_was_joined_to_home_counts_as_home():
    world, _ = Cloud(60, seed=0).mapped([pose_at(0.02 * i) for i in range(6)])
    parts = Parts.given({3: 3, 4: 3, 5: 3})
    parts.current = 3
    assert parts.merge(4, 1)
    assert (parts.at_home, parts.size(world), parts.newest(world).id) == (True, 6, 5)
    parts.begin(9)
    assert parts.small(3) == set(), "no part of its own is left that might go"
