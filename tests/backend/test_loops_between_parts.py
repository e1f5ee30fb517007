"""Loops between separate parts of one map, and between pieces of one part that no point ties."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend.connectivity import joined_pieces
from prism_edge.backend.loop_closing import Accepted, LoopCloser
from prism_edge.backend.loops import Loop
from prism_edge.backend.mapper import Mapper
from prism_edge.backend.pose_graph import Similarity
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import inverse, se3_exp, se3_log, transform
from prism_edge.messages import HOME
from tests.backend.closing import DRIFT, finish, two_parts, walk
from tests.backend.ring import Ring, position_error
from tests.backend.world import chain, check, poses_of
from tests.tracking.cloud import pose_at

BROKEN = range(22, 27)  # keyframes without which the ring is in two pieces


@pytest.mark.parametrize("odometer", [1.0, 1000.0])
def test_a_copy_of_a_place_is_refused_where_keyframes_between_were_never_heard_of(odometer):
    """A backend was started anew meanwhile: nothing ties the two pieces, but the camera was followed."""
    ring = Ring(alike=True)
    mapper = walk(ring, 38, odometer=odometer, unheard=BROKEN)
    assert len(joined_pieces(mapper.world, [])) == 2
    assert not mapper.loops.accepted
    assert position_error(poses_of(mapper.world), ring.true) < 0.02


def test_a_right_loop_between_two_pieces_of_home_is_believed():
    ring, plain = (Ring(drift=DRIFT, stretch=1.004) for _ in range(2))
    before = position_error(poses_of(walk(plain, 46, places=False).world), plain.true)
    mapper = walk(ring, 46, unheard=BROKEN)
    assert mapper.loops.accepted
    assert all(loop.units is None for loop in mapper.loops.accepted)
    finish(mapper)
    assert position_error(poses_of(mapper.world), ring.true) < 0.2 * before


def carried_off(ring: Ring) -> None:
    """What the tracker's next keyframe sees is new to it, and where that is it doesn't know."""
    ring.ids.clear()
    ring.part = len(ring.told)
    ring.told[-1] = se3_exp(np.array([4.0, -2.0, 1.0, 0.4, -0.9, 0.3])) @ ring.told[-1]


def test_a_part_mapped_apart_is_merged_when_its_place_is_recognised():
    """A third of the ring, carried off blind, the rest on its own: the new part moves, the old stays."""
    ring = Ring(lap=32)
    mapper = walk(ring, 10)
    carried_off(ring)
    for poses in (ring.true, ring.told):
        poses += 4 * [poses[-1]]  # it comes to itself four steps on
    before = {k: pose.copy() for k, pose in poses_of(mapper.world).items()}
    mapper = walk(ring, 26, mapper=mapper)
    first = mapper.loops.accepted[0]
    assert first.candidate < 10 <= first.query
    unit, sigma = first.units
    assert abs(unit) < 0.02  # the new part was told in the old one's unit
    assert 0.0 < sigma < 0.02
    assert all(later.units is None for later in mapper.loops.accepted[1:])
    assert mapper.whole(35, mapper.loops.take_changes(), closed=first).loop_units.tolist() == [unit, sigma]
    assert not len(mapper.whole(35, mapper.loops.take_changes()).loop_units)
    finish(mapper)
    poses = poses_of(mapper.world)
    assert position_error(poses, ring.true) < 0.05
    for k, pose in before.items():
        assert np.abs(se3_log(inverse(pose) @ poses[k])).max() < 0.05
    check(mapper.world)


@pytest.mark.parametrize(
    ("measured", "firm", "known", "wanted"),
    [
        ((2.0, 0.08), 10, (0.0, 0.1), (0.5 * np.log(2.0), 0.1 / np.sqrt(2.0), 0.1)),  # 0.06 beside
        ((2.0, 0.08), 10, (0.0, 1e3), (np.log(2.0), 0.1, 0.1)),
        ((2.0, 0.0), 9, (0.4, 0.05), (0.4, 0.05, 10.0)),  # what nothing has triangulated measures nothing
    ],
)
def test_the_unit_of_a_part_that_is_joined_rests_on_both_parts_metres_too(measured, firm, known, wanted):
    closer = two_parts()
    world = closer._world
    for k, keyframe in world.keyframes.items():
        keyframe.part = HOME if k < 100 else 100
    own = {keypoint: p for p, keypoint in world.keyframes[102].observed.items()}
    pairs = list(zip(own, sorted(world.keyframes[3].observed), strict=False))[:30]
    for i, (keypoint, point) in enumerate(pairs):  # of some only the one end has triangulated theirs
        world.points[own[keypoint]].parallax_deg = 3.0 if i < firm or i % 2 else 0.5
        world.points[point].parallax_deg = 3.0 if i < firm or not i % 2 else 0.5
    loop, asked = Loop(102, 3, np.eye(4), *measured, 50, 2, pairs), []

    def of_parts(part: int, other: int) -> tuple[float, float]:
        asked.append((part, other))
        return known

    found, alone = closer._with_known_units(loop, of_parts)
    assert asked == [(100, HOME)]
    assert (np.log(found.scale), found.log_scale_sigma, alone) == pytest.approx(wanted)
    assert closer._with_known_units(loop, lambda *parts: None) == (loop, loop.log_scale_sigma)
    within = replace(loop, candidate=100)
    assert closer._with_known_units(within, of_parts) == (within, loop.log_scale_sigma)


def test_what_a_part_still_sends_in_its_own_unit_after_it_was_joined_is_understood():
    """The tracker has not heard of the loop yet."""
    ring = Ring(lap=32)
    mapper = walk(ring, 10)
    carried_off(ring)
    ring.unit = 2.0
    for poses in (ring.true, ring.told):
        poses += 4 * [poses[-1]]
    while not mapper.loops.accepted:
        mapper = walk(ring, 1, mapper=mapper)
    assert mapper.loops.accepted[0].units[0] == pytest.approx(-np.log(2.0), abs=0.05)
    message = ring.keyframe()
    assert len(message.new_points) > 5
    here = mapper.world.absorb(message).world_from_camera
    to_true, to_here = inverse(ring.true[message.id]), inverse(here)
    for point in message.new_points.tolist():
        true = transform(to_true, ring.points[ring.point_of[point]][None])[0, 2]
        found = transform(to_here, mapper.world.points[point].position[None])[0, 2]
        assert found == pytest.approx(true, rel=0.08)


@pytest.mark.parametrize("query_in_newer", [True, False])
def test_what_loops_measured_in_a_part_is_in_the_unit_that_it_has_once_it_was_joined(query_in_newer):
    """The newer part's lengths are told as half of what they are in the older one's unit."""
    mapper = Mapper(BackendConfig(), use_depth=False)
    world, loops = mapper.world, mapper.loops
    chain([pose_at(0.3 * i) for i in range(8)], 0, world)
    chain([pose_at(50 + 0.15 * i) for i in range(12)], 100, world)
    for k, keyframe in world.keyframes.items():
        keyframe.part = 0 if k < 100 else 100
    loops._join_neighbours = lambda loop: 0  # there are no pictures
    assert loops._close(Loop(110, 101, world.keyframes[110].world_from_camera.copy(), 1.0, 0.001, 50, 3, []))
    if query_in_newer:
        joining = Loop(103, 2, pose_at(0.3 * 2 + 0.05), 2.0, 0.001, 50, 3, [])
    else:
        joining = Loop(2, 103, pose_at(50 + 0.15 * 3 - 0.025), 0.5, 0.001, 50, 3, [])
    assert loops._close(joining)
    for said in loops.accepted:
        ends = (world.keyframes[k].world_from_camera for k in (said.candidate, said.query))
        true = inverse(next(ends)) @ next(ends)
        assert said.candidate_from_query == pytest.approx(true, abs=0.02)
    assert loops.accepted[0].candidate_from_query[0, 3] == pytest.approx(2.7, abs=0.05)


def test_a_part_that_was_joined_to_another_has_that_ones_unit_too_once_both_are_joined():
    """The tracker may have heard of the first loop, of both, or of none."""
    mapper = Mapper(BackendConfig(), use_depth=False)
    world, loops = mapper.world, mapper.loops
    starts = {HOME: 0, 3: 100, 6: 200}
    for part, start in starts.items():
        chain([pose_at(start + 0.3 * i) for i in range(8)], start, world)
        for k in range(start, start + 8):
            world.keyframes[k].part = part
    loops._join_neighbours = lambda loop: 0  # there are no pictures
    before = poses_of(world)
    assert loops._close(Loop(203, 102, pose_at(100.7), 2.0, 0.001, 50, 3, []))
    assert {part: round(by, 2) for part, by in world.growth.items()} == {6: 2.0}
    assert loops._close(Loop(204, 2, pose_at(0.7), 1.5, 0.001, 50, 3, []))
    assert {part: round(by, 2) for part, by in world.growth.items()} == {6: 3.0, 3: 1.5}
    for start, by in zip(starts.values(), (1.0, 1.5, 3.0), strict=True):
        for k in range(start, start + 7):
            steps = [inverse(poses[k]) @ poses[k + 1] for poses in (before, poses_of(world))]
            assert steps[1][0, 3] == pytest.approx(by * steps[0][0, 3], rel=0.02)
            assert world.keyframes[k].grown == pytest.approx(by, rel=0.02)


def test_a_part_of_its_own_is_adjusted_without_being_merged():
    ring = Ring(lap=32)
    mapper = walk(ring, 10)
    carried_off(ring)
    mapper = walk(ring, 6, places=False, mapper=mapper)
    for k in (0, 10):
        apart = joined_pieces(mapper.world, [])
        assert any(k == min(part) for part in apart)
    mapper.loops._wanted, before = True, poses_of(mapper.world)
    finish(mapper)
    poses = poses_of(mapper.world)
    assert poses[0] == pytest.approx(ring.told[0], abs=0.01)
    assert poses[10] == pytest.approx(before[10], abs=0.01)
    assert all(np.isfinite(pose).all() for pose in poses.values())


def between_parts(loops: LoopCloser, query: int, neighbours: int) -> Loop:
    there = pose_at(-49.0, 0.5) @ loops._world.keyframes[query].world_from_camera
    return Loop(query, 3, there, 1.0, 0.01, 50, neighbours, [])


@pytest.mark.parametrize(("neighbours", "believed"), [(0, False), (1, True)])
def test_between_parts_of_a_map_a_loop_needs_a_neighbour_and_another_loop(neighbours, believed):
    """No way bounds what a place that looks alike may ask for."""
    loops = two_parts()
    assert not loops._confirmed(between_parts(loops, 102, 4))  # nothing but neighbours
    assert loops._confirmed(between_parts(loops, 103, neighbours)) == believed


@pytest.mark.parametrize("gone", [None, 100, 103])
def test_what_a_loop_measured_is_in_the_unit_of_its_part_though_an_end_was_culled(gone):
    loops = two_parts()
    loops.accepted.append(Accepted(103, 100, 1030, 1000, pose_at(0.9, 0.0, 0.0, 0.0, 0.2), 50))
    loops._in_new_units({k: Similarity(np.eye(4), 2.0, unit=2.0) for k in (100, 103) if k != gone})
    said = loops.accepted[0].candidate_from_query
    assert said[:3, 3] == pytest.approx(2.0 * pose_at(0.9, 0.0, 0.0, 0.0, 0.2)[:3, 3])
    assert said[:3, :3] == pytest.approx(pose_at(0.9, 0.0, 0.0, 0.0, 0.2)[:3, :3])
