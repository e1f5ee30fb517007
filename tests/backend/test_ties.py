"""Which keyframes get their size from those held: on drives, where these break, after turns on the spot."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.global_map import GlobalKeyframe, GlobalMap, GlobalPoint
from prism_edge.backend.ties import LEAST_PLACED, PLACED_DEG, at_one_spot, median_range, untied
from tests.tracking.cloud import CAMERA, pose_at

STEP = 0.1  # metres between keyframes that drive sideways, along x
RANGE = 1.0  # metres: of every point


def driving(count: int, spans: list[tuple[int, int]], each: int = LEAST_PLACED) -> GlobalMap:
    """Keyframes a step apart; for each span ``each`` points that all keyframes in it see, its ends too.

    Over a step of 0.1 m at a range of 1 m rays differ by 5.7 degrees.
    """
    world = GlobalMap()
    for k in range(count):
        pixels = np.zeros((each * len(spans), 2))
        pose = pose_at(STEP * k)
        world.keyframes[k] = GlobalKeyframe(k, k, CAMERA, pose, pixels, np.ones(len(pixels)), {})
    for i, (first, last) in enumerate(spans):
        for p in range(i * each, (i + 1) * each):
            position = np.array([STEP * (first + last) / 2.0, 0.0, RANGE])
            world.points[p] = GlobalPoint(position)
            for k in range(first, last + 1):
                world.observe(k, p, p)
    return world


def left(world: GlobalMap, held: list[int], free: list[int]) -> list[int]:
    return untied(world, held, free, sorted(world.points))


def test_points_that_two_held_poses_place_tie_who_sees_them():
    assert left(driving(3, [(0, 2)]), [0, 1], [2]) == []


def test_a_chain_of_points_ties_keyframes_that_share_none_with_those_held():
    spans = [(k, k + 2) for k in range(6)]
    assert left(driving(8, spans), [0, 1], [2, 3, 4, 5, 6, 7]) == []


def test_from_where_the_chain_breaks_nothing_is_tied():
    """Keyframe 4 sees what 3 sees and nothing else: from one place, points may be of any size."""
    spans = [(0, 2), (1, 3), (3, 4), (4, 6), (5, 7)]
    assert left(driving(8, spans), [0, 1], [2, 3, 4, 5, 6, 7]) == [4, 5, 6, 7]


def test_a_chain_may_come_from_either_end():
    spans = [(0, 2), (1, 3), (3, 4), (4, 6), (5, 7)]
    assert left(driving(8, spans), [6, 7], [0, 1, 2, 3, 4, 5]) == [0, 1, 2, 3]
    assert left(driving(8, spans), [0, 1, 6, 7], [2, 3, 4, 5]) == []


def test_poses_held_at_one_spot_tie_nothing_however_many_they_are():
    """A turn there: none of them, and no free one, is placed by what the others see of it."""
    spot = driving(9, [(0, 8)] * 5)
    for k in range(6):
        spot.keyframes[k].world_from_camera = pose_at(0.0, 0.0, 0.0, 0.0, 0.1 * k)
    assert left(spot, [0, 1, 2, 3, 4, 5], [6, 7, 8]) == [6, 7, 8]


@pytest.mark.parametrize(("degrees", "expected"), [(PLACED_DEG - 0.05, [2]), (PLACED_DEG + 0.05, [])])
def test_how_much_parallax_among_those_tied_places_a_point(degrees: float, expected: list[int]):
    """The free one sees it from afar: that its own ray differs says nothing of how far the point is."""
    world = driving(3, [(0, 2)])
    half = RANGE * np.tan(np.radians(degrees) / 2.0)
    for k, x in enumerate((-half, half, 0.5)):
        world.keyframes[k].world_from_camera = pose_at(x)
    for point in world.points.values():
        point.position = np.array([0.0, 0.0, RANGE])
    assert left(world, [0, 1], [2]) == expected


@pytest.mark.parametrize(("count", "expected"), [(LEAST_PLACED - 1, [2]), (LEAST_PLACED, [])])
def test_how_many_placed_points_tie_a_keyframe(count: int, expected: list[int]):
    assert left(driving(3, [(0, 2)], count), [0, 1], [2]) == expected


def test_points_that_the_window_leaves_out_tie_nothing():
    world = driving(3, [(0, 2), (1, 2)])
    assert untied(world, [0, 1], [2], list(range(LEAST_PLACED, 2 * LEAST_PLACED))) == [2]


def test_without_points_or_without_held_poses_all_are_loose_and_of_none_none():
    world = driving(3, [(0, 2)])
    assert untied(world, [0, 1], [2], []) == [2]
    assert left(world, [], [2, 0, 1]) == [2, 0, 1]
    assert left(world, [0, 1], []) == []


def test_the_order_is_that_of_the_free_ones():
    assert left(driving(8, [(4, 7)]), [0, 1], [7, 5, 6, 4]) == [7, 5, 6, 4]


@pytest.mark.parametrize(("degrees", "together"), [(PLACED_DEG - 0.1, True), (PLACED_DEG + 0.1, False)])
def test_poses_stand_at_one_spot_where_no_two_of_them_place_what_the_newest_sees(degrees, together):
    world = driving(3, [(0, 2)])
    for k, share in enumerate((0.0, 1.0, 0.4)):
        world.keyframes[k].world_from_camera = pose_at(share * 4.0 * np.radians(degrees))
    for point in world.points.values():
        point.position = world.keyframes[2].world_from_camera[:3, 3] + (0.0, 0.0, 4.0)
    for k in (0, 1):  # what the others see doesn't count
        world.points[k].position = np.array([0.0, 0.0, 1000.0])
        world.keyframes[k].observed = {k: k}
    assert at_one_spot(world, [0, 1, 2]) == together


def test_the_median_range_is_of_a_keyframe_s_points_from_where_it_stands():
    world = driving(2, [(0, 1)], each=3)
    for p, z in enumerate((1.0, 2.0, 9.0)):
        world.points[p].position = np.array([STEP, 0.0, z])
    assert median_range(world, 1) == pytest.approx(2.0)
    world.keyframes[0].observed.clear()
    assert median_range(world, 0) == 0.0
    assert not at_one_spot(world, [0]), "it sees nothing that could be placed or not"
