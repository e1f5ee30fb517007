"""Loops from end to end on a ring: a drifting walk comes back, and what only looks alike does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend import loop_closing as module
from prism_edge.backend.global_adjustment import Adjusted, GlobalAdjustment
from prism_edge.backend.loop_closing import LoopCloser
from prism_edge.backend.loops import Loop
from prism_edge.backend.mapper import Mapper
from prism_edge.backend.places import SOME_SHARED
from prism_edge.geometry.poses import inverse, rotation_angle, se3_exp, se3_log
from tests.backend.closing import CONFIG, DRIFT, finish, hear, two_parts, walk
from tests.backend.returning import CANDIDATES, QUERY, off_along_rays, pose_by_points, seen_again
from tests.backend.ring import Ring, position_error
from tests.backend.world import check, poses_of, quiet
from tests.tracking.cloud import pose_at


@pytest.fixture(scope="module")
def closed() -> tuple[Ring, Mapper, float]:
    """A ring walked once and a little more, by a tracker whose place and scale drift."""
    ring = Ring(drift=DRIFT, stretch=1.004)
    mapper = walk(ring, 46)
    plain = walk(Ring(drift=DRIFT, stretch=1.004), 46, places=False)
    return ring, mapper, position_error(poses_of(plain.world), ring.true)


def test_a_drifted_walk_is_restored(closed):
    ring, mapper, before = closed
    assert before > 0.14
    assert mapper.loops.accepted
    finish(mapper)
    assert position_error(poses_of(mapper.world), ring.true) < 0.1 * before
    check(mapper.world)


def test_a_late_return_has_the_whole_way_round_to_drift():
    """No tie leads across, so the way by ties is as long as the camera's own: its drift is believed."""
    ring, moved = Ring(stretch=1.012), []
    mapper = Mapper(CONFIG, use_depth=False)
    while not mapper.loops.accepted and len(ring.true) < 44:
        before = poses_of(mapper.world)
        walk(ring, 1, mapper=mapper, odometer=1000.0)
        moved = [np.linalg.norm(poses_of(mapper.world)[k][:3, 3] - before[k][:3, 3]) for k in before]
    (first,) = mapper.loops.accepted
    assert first.query - first.candidate > 30
    assert max(moved) > 1.0


def test_each_loop_says_where_the_query_is_from_its_candidate(closed):
    ring, mapper, _ = closed
    accepted = mapper.loops.accepted
    assert accepted
    for loop in accepted:
        true = inverse(ring.true[loop.candidate]) @ ring.true[loop.query]
        # In the map's own unit, which has drifted by a tenth.
        found = loop.candidate_from_query[:3, 3]
        unit = float(found @ true[:3, 3] / (true[:3, 3] @ true[:3, 3]))
        assert unit == pytest.approx(1.0, abs=0.2)
        assert np.linalg.norm(found - unit * true[:3, 3]) < 0.05
        assert rotation_angle(true[:3, :3].T @ loop.candidate_from_query[:3, :3]) < 0.01
        assert (loop.query_index, loop.candidate_index) == (10 * loop.query, 10 * loop.candidate)
        assert loop.inliers >= CONFIG.loop_inliers


def test_what_a_loop_measured_is_said_also_where_it_moves_its_candidate():
    ring = Ring(drift=2.0 * DRIFT, stretch=1.01)
    accepted = walk(ring, 46).loops.accepted
    assert accepted
    for loop in accepted:
        true = inverse(ring.true[loop.candidate]) @ ring.true[loop.query]
        assert rotation_angle(true[:3, :3].T @ loop.candidate_from_query[:3, :3]) < np.radians(0.4)


def test_double_points_become_one_and_the_tracker_is_told(closed):
    ring, mapper, _ = closed
    last = mapper.loops.accepted[-1]
    update = mapper.whole(45, mapper.loops.take_changes(), closed=last)
    assert update.loop_query >= 0
    assert (update.loop_query, update.loop_candidate) == (last.query, last.candidate)
    assert len(update.fused_from) > 50
    pairs = zip(update.fused_from, update.fused_into, strict=True)
    same = [ring.point_of[a] == ring.point_of[b] for a, b in pairs]
    assert np.mean(same) > 0.98
    assert not np.isin(update.fused_from, update.points).any()
    assert np.isin(update.fused_into, update.points).mean() > 0.9
    assert not mapper.loops.take_changes().fused  # told once


def test_a_keyframe_that_still_speaks_of_a_double_is_understood():
    ring = Ring(drift=DRIFT)
    mapper = walk(ring, 42)
    assert mapper.loops.accepted
    gone = {a for a, _ in mapper.loops.changes.fused}
    message = ring.keyframe()
    spoken = gone & set(message.points.tolist())
    assert spoken
    mapper.absorb(message)
    check(mapper.world)
    observed = mapper.world.keyframes[message.id].observed
    assert not gone & set(observed)
    assert {mapper.world.present(p) for p in spoken} & set(observed)


@pytest.mark.parametrize("odometer", [1.0, 1000.0])
def test_a_place_that_only_looks_the_same_is_refused(odometer):
    """The far side of the ring is a copy of the near one, corner by corner: half a ring is no drift.

    However long the camera has stood and trembled on its way.
    """
    ring = Ring(alike=True)
    mapper = walk(ring, 34, odometer=odometer)
    ranked = mapper.loops.index.rank(ring.looks_like(30), range(20))
    assert ranked[0][0] == 10  # it is what the network would say
    assert not mapper.loops.accepted
    assert position_error(poses_of(mapper.world), ring.true) < 0.01


def test_without_descriptors_there_are_no_loops():
    assert not walk(Ring(drift=DRIFT), 44, places=False).loops.accepted


def test_of_a_keyframe_that_is_not_here_no_place_is_noted():
    """Culled before its depth came: nobody would ever forget it."""
    mapper = walk(Ring(), 3, places=False)
    assert not mapper.loops.add_place(3, np.eye(16, dtype=np.float32)[3])
    assert mapper.loops.add_place(2, np.eye(16, dtype=np.float32)[2])
    assert len(mapper.loops.index) == 1


def test_a_place_half_known_needs_no_word_of_the_network():
    ring = Ring(drift=DRIFT / 4)
    mapper = walk(ring, 41, places=False)
    message = ring.keyframe()
    mapper.absorb(message)
    world, first = mapper.world, mapper.world.keyframes[1].observed
    again = [p for p in message.points.tolist() if p not in first]
    before = {ring.point_of[p]: p for p in first}
    pairs = [(p, before[ring.point_of[p]]) for p in again if ring.point_of[p] in before]
    for mine, earlier in pairs[:SOME_SHARED]:  # what the tracker found again by itself
        world.fuse(mine, earlier)
    accepted = mapper.loops.look(message.id)
    assert accepted is not None
    assert abs(accepted.candidate - 1) <= 2
    check(world)


def test_descriptors_that_are_all_equal_do_no_harm():
    ring = Ring(drift=DRIFT)
    mapper = Mapper(CONFIG, use_depth=False)
    for message in ring.keyframes(46):
        hear(mapper, ring, message, np.ones(16, np.float32))
    finish(mapper)
    for loop in mapper.loops.accepted:
        true = inverse(ring.true[loop.candidate]) @ ring.true[loop.query]
        assert np.abs(se3_log(inverse(true) @ loop.candidate_from_query)).max() < 0.1
    assert all(np.isfinite(pose).all() for pose in poses_of(mapper.world).values())


def test_a_keyframe_without_features_closes_nothing():
    ring = Ring()
    mapper = walk(ring, 30)
    blind = quiet(ring.keyframe())
    hear(mapper, ring, blind, ring.looks_like(5))
    assert not mapper.loops.accepted
    assert mapper.loops.look(999) is None


def test_two_keyframes_at_one_pose_are_no_trouble():
    ring = Ring(drift=DRIFT)
    mapper = walk(ring, 40)
    message = ring.keyframe(ring.true[-1])
    hear(mapper, ring, message, ring.looks_like(message.id))
    mapper = walk(ring, 2, mapper=mapper)
    finish(mapper)
    assert all(np.isfinite(pose).all() for pose in poses_of(mapper.world).values())
    check(mapper.world)


def test_a_loop_that_fits_already_moves_nothing_but_joins_points():
    ring = Ring()
    mapper = walk(ring, 43)
    assert mapper.loops.accepted
    assert mapper.loops.changes.fused
    for k, pose in poses_of(mapper.world).items():
        assert np.abs(se3_log(inverse(ring.true[k]) @ pose)).max() < 0.01


def test_too_few_agreeing_points_are_no_loop():
    ring = Ring(drift=DRIFT)
    strict = Mapper(replace(CONFIG, loop_inliers=1000), use_depth=False)
    assert not walk(ring, 44, mapper=strict).loops.accepted


@pytest.mark.parametrize(("apart_s", "due"), [(0.3, False), (10.0, True)])
def test_the_next_adjustment_waits_for_eight_keyframes_or_ten_seconds(apart_s, due):
    """In a known place eight keyframes take more than a minute."""
    ring = Ring(drift=DRIFT, stretch=1.004)
    mapper = walk(ring, 46)
    finish(mapper)
    first = len(mapper.loops.accepted)
    assert not mapper.loops.adjusting
    stamp_ns, heard = max(k.stamp_ns for k in mapper.world.keyframes.values()), 0
    while len(mapper.loops.accepted) == first:
        message, heard = ring.keyframe(), heard + 1
        later = replace(message, stamp_ns=stamp_ns + int(heard * apart_s * 1e9))
        hear(mapper, ring, later, ring.looks_like(message.id))
    assert heard < module.REST
    assert mapper.loops.unfinished
    assert mapper.loops.adjusting == due


def test_two_walks_are_the_same_to_the_last_bit():
    found = []
    for _ in range(2):
        mapper = walk(Ring(drift=DRIFT), 43)
        finish(mapper)
        found.append(np.array(list(poses_of(mapper.world).values())).tobytes())
    assert found[0] == found[1]


def test_no_more_loops_are_remembered_than_need_be(monkeypatch):
    """A camera that goes round for weeks: first go the loops whose keyframes were culled, then the oldest."""
    mapper = walk(Ring(drift=DRIFT), 44)
    assert mapper.loops.accepted
    loops, (first, *_) = mapper.loops, mapper.loops.accepted
    newest = replace(first, inliers=99)
    loops.accepted[:] = [replace(first, inliers=i) for i in range(4)] + [newest]
    loops.accepted[2] = replace(loops.accepted[2], query=10_000)  # no longer here
    loops._forget_one()
    assert [a.inliers for a in loops.accepted] == [0, 1, 3, 99]
    loops._forget_one()
    assert [a.inliers for a in loops.accepted] == [1, 3, 99]
    monkeypatch.setattr(module, "MOST_ACCEPTED", 1)
    assert len(walk(Ring(drift=DRIFT), 60).loops.accepted) == 1


def test_a_loop_ends_the_adjustment_that_was_under_way():
    """What that began with is out of date: its result would bend the map back."""
    ring = Ring(drift=DRIFT, stretch=1.004)
    mapper = walk(ring, 30)
    assert not mapper.loops.accepted
    mapper.loops._wanted = True
    mapper.loops.adjust(1.0)
    assert mapper.loops.under_way
    while not mapper.loops.accepted:
        drifted = position_error(poses_of(mapper.world), ring.true)
        walk(ring, 1, mapper=mapper)
    assert not mapper.loops.under_way
    while mapper.loops.unfinished:
        mapper.loops.adjust(1.0)
        assert position_error(poses_of(mapper.world), ring.true) < 0.1 * drifted


def test_an_overhaul_ends_the_adjustment_that_was_under_way_and_wants_another_at_once():
    mapper = walk(Ring(), 12, places=False, mapper=Mapper(replace(CONFIG, lens=False), use_depth=False))
    mapper.loops._wanted = True
    mapper.loops.adjust(1.0)
    assert mapper.loops.under_way
    assert mapper.loops._last_begun == mapper.loops._count
    mapper.loops.overhaul()
    assert not mapper.loops.under_way
    assert mapper.loops.adjusting, "without a rest"


def test_an_adjustment_that_fits_worse_than_what_there_was_is_not_taken(monkeypatch):
    mapper = walk(Ring(), 6, places=False)
    mapper.loops._wanted = True
    before = poses_of(mapper.world)
    away = {k: pose_at(1.0 * k) @ pose for k, pose in before.items()}
    worse = Adjusted(away, {}, error_before=10.0, error_after=11.0, steps=3, cpu_s=0.0)
    monkeypatch.setattr(GlobalAdjustment, "result", lambda _: worse)
    while mapper.loops.unfinished:
        assert mapper.loops.adjust(1.0) is None
    for k, pose in poses_of(mapper.world).items():
        assert np.array_equal(pose, before[k])


@pytest.mark.parametrize(
    ("scale", "sigma", "slight"),
    [(1.001, 0.001, True), (1.05, 0.001, False), (0.95, 0.02, False), (1.05, 0.04, True)],
)
def test_a_loop_that_asks_for_another_unit_is_not_slight(scale, sigma, slight):
    world, query, pairs = seen_again()
    loop = Loop(query.id, 0, query.world_from_camera.copy(), scale, sigma, len(pairs), 3, pairs)
    assert LoopCloser(world, CONFIG, False)._slight(loop, query) == slight


@pytest.mark.parametrize("drift", [0.0, 0.05])
def test_a_loop_moves_what_has_drifted_and_no_map_that_explains_its_points(drift):
    """Its pose goes wrong with the depths of points seen under little parallax."""
    world, query, pairs = seen_again()
    off_along_rays(world, pairs, 0.4)
    there = pose_by_points(world, query, pairs)
    query.world_from_camera = query.world_from_camera @ se3_exp(np.array([0, 0, 0, 0, drift, 0]))
    before = {k: pose.copy() for k, pose in poses_of(world).items()}
    assert rotation_angle(before[query.id][:3, :3].T @ there[:3, :3]) > np.radians(1.0)
    loops = LoopCloser(world, CONFIG, False)
    loops._part = set(before)
    assert loops._close(Loop(query.id, 0, there, 1.0, 0.01, len(pairs), 3, pairs))
    assert world.keyframes[query.id].observed
    stayed = all(np.array_equal(poses_of(world)[k], before[k]) for k in before)
    assert stayed == (drift == 0.0)


def test_a_loop_s_points_that_are_off_in_depth_don_t_take_the_query_along():
    """It has drifted by 2.9 degrees, and by its points as the map has them would come back a degree aside."""
    world, query, pairs = seen_again()
    off_along_rays(world, pairs, 0.4)
    there = pose_by_points(world, query, pairs)
    assert rotation_angle(QUERY[:3, :3].T @ there[:3, :3]) > np.radians(1.0)
    query.world_from_camera = query.world_from_camera @ se3_exp(np.array([0, 0, 0, 0, 0.05, 0]))
    loops = LoopCloser(world, CONFIG, False)
    loops._part = set(world.keyframes)
    assert loops._close(Loop(query.id, 0, there, 1.0, 0.01, len(pairs), 3, pairs))
    back = inverse(CANDIDATES[0]) @ QUERY
    off = inverse(loops.accepted[0].candidate_from_query) @ back
    assert rotation_angle(off[:3, :3]) < np.radians(0.4)


def test_two_points_that_one_keyframe_tells_apart_stay_two():
    loops = two_parts()
    world = loops._world
    view, own = world.keyframes[100], {i: p for p, i in world.keyframes[100].observed.items()}
    apart, far = 0, 1  # of the other end
    world.observe(101, apart, 150)
    assert own[101] in world.keyframes[101].observed
    assert loops._join(view, [(101, apart), (102, far)]) == 1
    assert loops.changes.fused == [(own[102], far)]
    assert {own[101], apart} <= world.points.keys()
    assert own[102] not in world.points
    assert apart not in view.observed


def test_a_loop_that_can_not_be_vouches_for_none_that_barely_can():
    """A place that looks alike from farther and farther on: the way grows, and what drift may have done."""
    loops = two_parts()
    for k, keyframe in loops._world.keyframes.items():
        keyframe.travelled = 0.3 * k

    def confirmed(query: int, aside: float) -> bool:
        there = pose_at(0.0, aside) @ loops._world.keyframes[query].world_from_camera
        return loops._confirmed(Loop(query, 0, there, 1.0, 0.01, 50, 0, []))

    assert not confirmed(3, 1.2)  # a twentieth of the depth and half of the way are 0.6
    assert not confirmed(4, 0.55)  # by itself
    assert confirmed(5, 0.55)  # with the one before


@pytest.mark.parametrize(
    ("off", "alike"),
    [
        (pose_at(0.0, 0.0, 0.0, 0.0, np.radians(2.9)), True),
        (pose_at(0.0, 0.0, 0.0, 0.0, np.radians(3.1)), False),
        (pose_at(0.0, 0.44), True),
        (pose_at(0.0, 0.46), False),
    ],
)
def test_two_loops_vouch_for_each_other_where_they_move_the_newest_view_alike(off, alike):
    """By 3 degrees and 0.15 of its median depth, 3, wherever the map's origin is."""
    loops = two_parts()
    world = loops._world
    view, before = (world.keyframes[k].world_from_camera for k in (103, 102))
    back = pose_at(-40.0, 3.0, 0.0, 0.0, 1.0)
    one = Loop(103, 3, back @ view, 1.0, 0.01, 50, 1, [])
    other = Loop(102, 2, back @ view @ off @ inverse(view) @ before, 1.0, 0.01, 50, 1, [])
    assert loops._alike(one, other) == alike


def test_what_hangs_together_is_found_anew_for_each_keyframe_that_is_looked_at():
    """Else the part of the one before would be taken for that of the next."""
    loops = two_parts()
    for query, connected in ((3, True), (101, False), (4, True)):
        loops.look(query)
        there = loops._world.keyframes[query].world_from_camera
        assert loops._connected(Loop(query, 0, there, 1.0, 0.01, 50, 3, [])) == connected


def test_at_the_end_all_that_came_since_the_last_adjustment_is_adjusted():
    ring, mapper = Ring(), Mapper(replace(CONFIG, lens=False), use_depth=False)
    for count in (6, 1):  # at first, and after an end that was none
        walk(ring, count, places=False, mapper=mapper)
        assert not mapper.loops.unfinished
        mapper.loops.finish()
        assert mapper.loops.unfinished
        finish(mapper)
        mapper.loops.finish()
        assert not mapper.loops.unfinished, "nothing has come since"
