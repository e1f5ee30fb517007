"""What a part of the map leaves behind that is culled before anything has joined it: nothing."""

from __future__ import annotations

import pytest

from prism_edge.backend.global_map import GlobalMap
from prism_edge.messages import HOME
from tests.backend.world import Teller, check, poses_of
from tests.tracking.cloud import pose_at

POSES = [pose_at(0.2 * i) for i in range(6)]


def with_a_part(first: int, part: int | None) -> GlobalMap:
    """A map whose keyframes from ``first`` on see nothing that the others do."""
    teller, world = Teller(), GlobalMap()
    for pose in POSES:
        world.absorb(teller.keyframe(pose))
    apart = {k for k in world.keyframes if k >= first}
    for p, point in list(world.points.items()):
        if point.keyframes & apart and point.keyframes - apart:
            for k in sorted(point.keyframes & apart):
                if p in world.keyframes[k].observed:
                    world.drop_observation(k, p)
    for k, keyframe in world.keyframes.items():
        keyframe.part = HOME if k < first else part
    check(world)
    return world


def test_no_frame_of_a_part_that_is_gone_hangs_on_another() -> None:
    world = with_a_part(3, part=3)
    for culled in (4, 3):
        world._forget_keyframe(culled)
        assert all(world.keyframes[anchor].part == 3 for anchor in world.carried.numbers[:, 1].tolist())
        assert culled in poses_of(world)
    world._forget_keyframe(5)
    assert len(world.carried) == 0
    assert set(poses_of(world)) == {0, 1, 2}, "nobody knows where the others were"
    world._forget_keyframe(1)
    assert world.carried.ids.tolist() == [1]
    check(world)


def test_what_is_culled_last_hangs_on_its_own_part_s_nearest() -> None:
    world = with_a_part(5, part=5)
    world.keyframes[5].part = HOME  # joined since, though no point says so yet
    world._forget_keyframe(5)
    assert world.carried.numbers.tolist() == [[5, 4, world.carried.numbers[0, 2]]]


@pytest.mark.parametrize("part", [None, 5])
def test_of_a_map_of_an_earlier_build_nobody_knows_the_parts(part: int | None) -> None:
    world = with_a_part(5, part)
    for keyframe in world.keyframes.values():
        keyframe.part = None if keyframe.id < 5 else part
    world._forget_keyframe(5)
    assert world.carried.numbers[0, 1] == 4
