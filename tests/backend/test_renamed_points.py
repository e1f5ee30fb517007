"""Points that become others here and in the tracker at once: whatever is said, each has one identity."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap, GlobalPoint
from prism_edge.backend.mapper import Mapper
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import from_rt
from prism_edge.messages import Keyframe
from tests.backend.world import Teller, check, quiet
from tests.tracking.cloud import CAMERA

POINTS = 6

_point = st.integers(0, POINTS - 1)
_pairs = st.lists(st.tuples(_point, _point), min_size=1, max_size=4)


def small_world() -> tuple[GlobalMap, Keyframe]:
    """A few points, each seen by one of two keyframes, and what the tracker said last."""
    world = GlobalMap()
    for k in range(2):
        pixels = np.zeros((POINTS, 2))
        world.keyframes[k] = GlobalKeyframe(k, k, CAMERA, np.eye(4), pixels, np.ones(POINTS), {})
    for point in range(POINTS):
        world.points[point] = GlobalPoint(np.zeros(3))
        world.observe(point % 2, point, point)
    return world, Teller(first=10).keyframe(np.eye(4))


def tell(world: GlobalMap, message: Keyframe, pairs: list[tuple[int, int]]) -> Keyframe:
    """The tracker's next keyframe, which has made these points one; the message."""
    said = quiet(message, fused_from=[a for a, _ in pairs], fused_into=[b for _, b in pairs])
    world.absorb(said)
    return said


def names(world: GlobalMap) -> dict[int, int]:
    """What each renamed point is called now. Fails where that has no end."""
    found = {}
    for point in world._now:
        name = point
        for _ in range(len(world._now)):
            name = world._now.get(name, name)
        assert name not in world._now, f"{world._now} goes round"
        found[point] = name
    return found


def test_what_a_loop_made_one_and_the_tracker_crosswise_has_an_end():
    """It hears of a' -> a and b' -> b while its own a -> b and b' -> a' are on their way."""
    world, message = small_world()
    a, a_too, b, b_too = range(4)
    world.fuse(a_too, a)
    world.fuse(b_too, b)
    message = tell(world, message, [(a, b), (b_too, a_too)])
    (name,) = {names(world).get(p, p) for p in range(4)}
    assert name in world.points
    assert {world.present(p) for p in range(4)} == {name}
    check(world)


def test_a_point_that_was_renamed_is_not_brought_back():
    world, _ = small_world()
    world.fuse(0, 1)
    world.fuse(2, 0)
    assert world.present(2) == 1
    assert not {0, 2} & set(world.points)
    check(world)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.booleans(), _pairs), max_size=8))
def test_any_sequence_of_fusions_leaves_each_point_one_name(said):
    world, message = small_world()
    for by_tracker, pairs in said:
        if by_tracker:
            message = tell(world, message, pairs)
        else:
            for old, kept in pairs:
                world.fuse(world.present(old), world.present(kept))
        assert not set(names(world)) & set(world.points), "a renamed point is still here"
        check(world)
    for point in range(POINTS):
        assert world.present(world.present(point)) == world.present(point)


def at(x: float) -> np.ndarray:
    return from_rt(np.eye(3), np.array([x, 0.0, 0.0]))


@pytest.mark.parametrize("first", [2, 50])
def test_a_keyframe_under_way_keeps_of_two_views_of_a_point_that_of_the_name_that_stays(first: int) -> None:
    """As if it had been heard before the two became one, and as the tracker does it."""
    seen = []
    for heard_before in (True, False):
        teller, mapper = Teller(), Mapper(BackendConfig(), use_depth=False)
        for k in range(3):
            mapper.absorb(teller.keyframe(at(0.1 * k)))
        told = teller.keyframe(at(0.3))
        shows = np.flatnonzero(told.points >= 0)
        second = 52 - first
        kept, gone = int(told.points[shows[first]]), int(told.points[shows[second]])
        if heard_before:
            mapper.absorb(told)
        mapper.world.fuse(gone, kept)
        if not heard_before:
            mapper.absorb(told)
        assert mapper.world.keyframes[told.id].observed[kept] == shows[first]
        seen.append(dict(mapper.world.keyframes[told.id].observed))
    assert seen[0] == seen[1]
