"""What a keyframe adds to a map: against plain counts over the observations."""

from __future__ import annotations

import pytest

from prism_edge.tracking.keyframe_culling import drop_keyframe
from prism_edge.tracking.redundancy import Redundancies, redundancy
from tests.tracking.cloud import counted, walk


def test_redundancy_is_the_share_of_points_that_three_others_see():
    world = walk(12, 0.3)
    shares = {k: redundancy(world, keyframe) for k, keyframe in world.keyframes.items()}
    assert shares == pytest.approx({k: counted(world, k) for k in world.keyframes})
    assert min(shares.values()) < 0.9 < max(shares.values())


def test_what_sees_nothing_is_all_redundant():
    world = walk(5)
    world.keyframes[2].points[:] = -1
    assert redundancy(world, world.keyframes[2]) == 1.0


def test_those_of_many_are_as_those_of_each_also_once_some_are_gone():
    world = walk(12, 0.25)
    world.keyframes[2].points[:] = -1
    numbers = [1, 2, 3, 5, 8, 9]
    many = Redundancies(world, numbers)
    for gone in (5, 0, 4, 1):
        there = [(i, k) for i, k in enumerate(numbers) if k in world.keyframes]
        found = many.now()
        assert [found[i] for i, _ in there] == [redundancy(world, world.keyframes[k]) for _, k in there]
        drop_keyframe(world, world.keyframes[gone])
    assert len(set(many.now().tolist())) > 3


def test_of_none_there_are_none():
    assert len(Redundancies(walk(3), []).now()) == 0
