"""A loop's correction spread over the way, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from prism_edge.backend import pose_graph
from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.loops import Loop
from prism_edge.backend.pose_graph import (
    LOOP_SHARE,
    Similarity,
    _carry,
    _noise_of,
    _similarity,
    apply,
    spread,
)
from prism_edge.geometry.poses import from_rt, inverse, se3_exp, so3_exp, so3_log, transform
from prism_edge.messages import HOME
from tests.backend.world import SHARED, chain, poses_of
from tests.tracking.cloud import pose_at


def loop(world: GlobalMap, query: int, candidate: int, pose: np.ndarray, scale: float = 1.0) -> Loop:
    return Loop(query, candidate, pose, scale, 0.001, 50, 3, [])


def test_a_turn_is_spread_evenly():
    """N equal joints and a loop: least squares gives each joint D / (N + v), v the loop's variance share."""
    n, gap = 20, np.array([0.0, 0.3, 0.0])
    poses = [from_rt(so3_exp(np.array([0.0, 0.1 * i, 0.0])), np.zeros(3)) for i in range(n + 1)]
    world = chain(poses)
    there = from_rt(poses[-1][:3, :3] @ so3_exp(gap), np.zeros(3))
    moved, _ = spread(world, loop(world, n, 0, there), [])
    for k in range(n + 1):
        turn = so3_log(poses[k][:3, :3].T @ moved[k].world_from_camera[:3, :3])
        assert turn == pytest.approx(gap * k / (n + LOOP_SHARE**2), abs=1e-4)
        assert moved[k].world_from_camera[:3, 3] == pytest.approx(np.zeros(3), abs=1e-4)


def test_what_a_loop_s_points_leave_open_is_left_to_the_way():
    """A loop as sure as its information: along x it knows hardly anything, along z all."""
    n = 20
    poses = [pose_at(0.1 * i) for i in range(n + 1)]
    world = chain(poses)
    there = poses[-1] @ se3_exp(np.array([0.2, 0.0, 0.2, 0.0, 0.0, 0.0]))
    known = np.diag([1e-3, 1e6, 1e6, 1e6, 1e6, 1e6])
    moved, _ = spread(world, replace(loop(world, n, 0, there), information=known), [])
    shift = moved[n].world_from_camera[:3, 3] - poses[-1][:3, 3]
    assert abs(shift[0]) < 0.02
    assert shift[2] > 0.18


def test_a_loop_s_noise_is_in_the_unit_of_the_query_s_end():
    """gtsam's tangent space: rotation first, lengths as the query's end has them."""
    there, unit = pose_at(1.0, 0.5), 2.0
    found = replace(loop(chain([pose_at()] * 2), 1, 0, there), scale=unit, log_scale_sigma=0.1)
    known = np.diag([1e4, 4e4, 9e4, 1e6, 4e6, 9e6])
    usual = np.diag(np.square(_noise_of(found, 3.0).sigmas()))
    added = _noise_of(replace(found, information=known), 3.0).covariance() - usual
    here = _similarity(there, unit)
    moved = (_similarity(there @ se3_exp(1e-5 * axis), unit) for axis in np.eye(6))
    tangents = np.array([here.localCoordinates(pose) for pose in moved]) / 1e-5
    expected = tangents.T @ np.linalg.inv(known) @ tangents
    assert added == pytest.approx(expected, rel=1e-3, abs=1e-10)


def test_drift_of_scale_is_taken_out():
    """Each step is 1 % shorter than the last; the loop says by how much in all."""
    n = 40
    turn = so3_exp(np.array([0.0, 2 * np.pi / n, 0.0]))
    true, told = [np.eye(4)], [np.eye(4)]
    for k in range(n):
        step = from_rt(turn, np.array([0.5, 0.0, 0.0]))
        true.append(true[-1] @ step)
        told.append(told[-1] @ from_rt(turn, np.array([0.5 * 0.99**k, 0.0, 0.0])))
    world = chain(told)
    moved, _ = spread(world, loop(world, n, 0, true[n], 0.99**-n), [])
    lengths = [
        np.linalg.norm(moved[k + 1].world_from_camera[:3, 3] - moved[k].world_from_camera[:3, 3])
        for k in range(n)
    ]
    assert max(lengths) / min(lengths) < 1.03
    assert 0.99**-n > 1.4  # what they were apart before
    assert np.median([s.scale for s in moved.values()]) == pytest.approx(1.0, abs=1e-6)


def test_points_and_depths_go_with_their_keyframe():
    world = chain([pose_at(0.1 * i) for i in range(4)])
    world.keyframes[2].depths, world.keyframes[2].depth_units = np.full(2 * SHARED, 3.0), 2.0
    before = {k: keyframe.world_from_camera for k, keyframe in world.keyframes.items()}
    places = {p: point.position for p, point in world.points.items()}
    motion = pose_at(0.3, -0.2, 0.1, 0.1, 0.2, -0.1)
    apply(world, {k: Similarity(motion @ pose, 1.5) for k, pose in before.items()})
    for k, keyframe in world.keyframes.items():
        for p in keyframe.observed:
            if min(world.points[p].keyframes) == k:
                was = transform(inverse(before[k]), places[p][None])[0]
                now = transform(inverse(keyframe.world_from_camera), world.points[p].position[None])[0]
                assert now == pytest.approx(1.5 * was, abs=1e-9)
    assert world.keyframes[2].depths == pytest.approx(4.5)
    assert world.keyframes[2].depth_units == pytest.approx(3.0)  # the network's metres are what they were


def test_measured_depths_go_with_the_unit_and_not_with_drift_that_is_taken_out():
    world = chain([pose_at(0.1 * i) for i in range(3)])
    for keyframe in world.keyframes.values():
        keyframe.depths, keyframe.depth_sigma = np.full(2 * SHARED, 3.0), 0.02
    units = {0: 1.0, 1: 1.0, 2: 1.25}
    apply(world, {k: Similarity(pose_at(0.1 * k), 1.05 * unit, unit) for k, unit in units.items()})
    for k, unit in units.items():
        assert world.keyframes[k].depths == pytest.approx(3.0 * unit)


def test_what_was_culled_keeps_its_place_beside_the_keyframe_that_it_hangs_on():
    world = chain([pose_at(0.1 * i) for i in range(4)])
    link = pose_at(0.2, 0.1, -0.1, 0.1, 0.2, 0.3)
    world.carried.add(77, 2, link, 5)
    world.carried.add(78, 3, link, 6)
    moved = {k: Similarity(pose_at(0.3 * k), 1.5 if k == 2 else 1.0) for k in range(4)}
    apply(world, moved)
    poses = poses_of(world)
    for culled, anchor, times in ((77, 2, 1.5), (78, 3, 1.0)):
        relative = inverse(moved[anchor].world_from_camera) @ poses[culled]
        assert relative[:3, 3] == pytest.approx(times * link[:3, 3], abs=1e-12)
        assert relative[:3, :3] == pytest.approx(link[:3, :3], abs=1e-12)


def test_what_hangs_on_neither_end_stays():
    world = chain([pose_at(0.3 * i) for i in range(6)])
    chain([pose_at(50.0 + 0.3 * i) for i in range(3)], first=100, world=world)
    moved, _ = spread(world, loop(world, 5, 0, pose_at(1.6, 0.1)), [])
    assert set(moved) == set(range(6))


def test_a_part_of_its_own_is_moved_as_one():
    """Two maps without a common point: the newer is carried to where the loop says, whatever its unit was."""
    world = chain([pose_at(0.3 * i) for i in range(6)])
    far = se3_exp(np.array([30.0, -5.0, 2.0, 0.5, 1.0, -0.3]))
    poses = [far @ pose_at(0.2 * i) for i in range(4)]
    chain(poses, first=100, world=world)
    there = pose_at(0.7, 0.2, 0.0, 0.0, 0.1, 0.0)
    moved, _ = spread(world, loop(world, 102, 3, there, 2.0), [])
    for k in range(6):
        assert moved[k].world_from_camera == pytest.approx(world.keyframes[k].world_from_camera, abs=1e-4)
        assert moved[k].scale == pytest.approx(1.0, abs=1e-4)
    for i in range(4):
        relative = inverse(poses[2]) @ poses[i]
        relative[:3, 3] *= 2.0
        assert moved[100 + i].world_from_camera == pytest.approx(there @ relative, abs=1e-3)
        assert moved[100 + i].scale == pytest.approx(2.0, abs=1e-3)
        assert moved[100 + i].unit == pytest.approx(2.0, abs=1e-3)
    assert {moved[k].unit for k in range(6)} == {1.0}


def test_two_keyframes_with_identical_poses():
    world = chain([pose_at(0.0), pose_at(0.0), pose_at(0.3)])
    moved, _ = spread(world, loop(world, 2, 0, pose_at(0.31)), [])
    assert all(np.isfinite(s.world_from_camera).all() for s in moved.values())


def test_nonsense_is_refused():
    world = chain([pose_at(0.3 * i) for i in range(4)])
    assert spread(world, loop(world, 3, 0, np.full((4, 4), np.nan)), []) is None


def test_the_unit_of_the_older_part_is_kept_however_small_it_is():
    """Its scale goes into everything that is told of the map; the newer one's unit is said."""
    world = chain([pose_at(1.0 + 0.3 * i) for i in range(3)])
    poses = [pose_at(50.0 + 0.2 * i) for i in range(6)]
    chain(poses, first=100, world=world)
    moved, log_unit = spread(world, loop(world, 102, 1, pose_at(1.3), 2.0), [])
    for k in range(3):
        assert moved[k].world_from_camera == pytest.approx(world.keyframes[k].world_from_camera, abs=1e-3)
        assert moved[k].scale == pytest.approx(1.0, abs=1e-3)
    for i in range(6):
        assert moved[100 + i].scale == pytest.approx(2.0, abs=1e-3)
    assert log_unit == pytest.approx(np.log(2.0), abs=1e-3)


def test_the_newer_part_may_be_the_candidate_s():
    world = chain([pose_at(0.3 * i) for i in range(4)])
    chain([pose_at(50.0 + 0.2 * i) for i in range(3)], first=100, world=world)
    back = loop(world, 2, 101, pose_at(50.3), 0.5)  # what is 1 in the query's is half in the candidate's
    moved, log_unit = spread(world, back, [])
    assert moved[3].scale == pytest.approx(1.0, abs=1e-3)
    assert moved[100].scale == pytest.approx(2.0, abs=1e-3)
    assert log_unit == pytest.approx(np.log(2.0), abs=1e-3)


def test_one_part_whose_ties_are_broken_keeps_its_unit_on_the_whole():
    """A few points are shared still: the tracker never left that part, and nobody told it of two units."""
    world = chain([pose_at(1.0 + 0.3 * i) for i in range(3)])
    chain([pose_at(50.0 + 0.2 * i) for i in range(6)], first=100, world=world)
    own, keypoint = next(iter(world.keyframes[100].observed.items()))
    world.drop_observation(100, own)
    world.observe(100, next(iter(world.keyframes[2].observed)), keypoint)
    moved, log_unit = spread(world, loop(world, 102, 1, pose_at(1.3), 2.0), [])
    assert log_unit is None
    assert moved[0].scale == pytest.approx(0.5, abs=1e-3)
    assert moved[100].scale == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("moving", ["query", "candidate"])
def test_a_part_that_is_moved_starts_where_the_loop_holds(moving):
    """Whichever end moves, and in its unit: the solver has nothing left to find."""
    world = chain([pose_at(0.3 * i) for i in range(3)])
    chain([pose_at(50.0 + 0.2 * i, 3.0, 0.0, 0.1, 0.2, 0.3) for i in range(3)], first=100, world=world)
    there = pose_at(0.7, 0.2, 0.0, 0.0, 0.1, 0.0)
    back, values = loop(world, 101, 1, there, 2.0), gtsam.Values()
    for k, keyframe in world.keyframes.items():
        values.insert(X(k), _similarity(keyframe.world_from_camera, 1.0))
    _carry(world, values, {100, 101, 102} if moving == "query" else {0, 1, 2}, back)
    measured = _similarity(inverse(world.keyframes[1].world_from_camera) @ there, 2.0)
    expected = values.atSimilarity3(X(1)).compose(measured)
    assert values.atSimilarity3(X(101)).equals(expected, 1e-9)


def test_a_map_in_another_unit_is_spread_alike():
    """How far a joint gives is a share of the depth: with all lengths five times as long all moves so far."""
    found = []
    for unit in (1.0, 5.0):
        poses = [from_rt(so3_exp(np.array([0.0, 0.05 * i, 0.0])), [0.3 * unit * i, 0, 0]) for i in range(9)]
        world = chain(poses)
        for point in world.points.values():
            first = world.keyframes[min(point.keyframes)].world_from_camera
            point.position = transform(first, np.array([[0.0, 0.0, 3.0 * unit]]))[0]
        there = poses[8] @ from_rt(so3_exp(np.array([0.05, 0.1, 0.0])), unit * np.array([0.2, 0.1, -0.1]))
        found.append(spread(world, loop(world, 8, 0, there, 1.1), [])[0])
    for k, moved in found[0].items():
        expected = moved.world_from_camera.copy()
        expected[:3, 3] *= 5.0
        assert found[1][k].world_from_camera == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("before", [0, 3, 6])
def test_home_stays_though_its_ties_are_broken_and_its_newest_piece_is_newer_than_the_part(before):
    """Also where its first are gone: the tracker has it stay, and takes the told unit for the part's."""
    home = [pose_at(0.3 * i) for i in range(6)]
    world = chain(home[:before])
    chain([pose_at(50.0 + 0.2 * i) for i in range(4)], first=10, world=world)
    chain(home[3:], first=20, world=world)
    for k, keyframe in world.keyframes.items():
        keyframe.part = 10 if 10 <= k < 20 else HOME
    moved, log_unit = spread(world, loop(world, 22, 11, pose_at(50.3), 0.5), [])
    for k in (*range(before), 20, 21, 22):
        assert moved[k].world_from_camera == pytest.approx(world.keyframes[k].world_from_camera, abs=1e-3)
        assert (moved[k].scale, moved[k].unit) == (pytest.approx(1.0, abs=1e-3), 1.0)
    assert moved[10].scale == pytest.approx(2.0, abs=1e-3)
    assert log_unit == pytest.approx(np.log(2.0), abs=1e-3)


def test_a_loop_between_two_pieces_of_one_part_tells_of_no_unit():
    """Nobody could take it: the tracker knows of one part. Its drift is spread over the way, as else."""
    world = chain([pose_at(0.3 * i) for i in range(3)])
    chain([pose_at(0.9 + 0.3 * i) for i in range(3)], first=20, world=world)
    for keyframe in world.keyframes.values():
        keyframe.part = HOME
    moved, log_unit = spread(world, loop(world, 22, 0, pose_at(1.4, 0.2)), [])
    assert log_unit is None
    assert set(moved) == set(world.keyframes)
    assert {similarity.unit for similarity in moved.values()} == {1.0}
    shifts = [float(moved[k].world_from_camera[1, 3]) for k in (0, 1, 2, 20, 21, 22)]
    assert shifts == sorted(shifts)
    assert shifts[2] > 0.02


def test_where_one_number_of_one_pose_is_none_nothing_is_moved(monkeypatch):
    """However sound all others are: the tracker would be told of it."""
    world = chain([pose_at(0.3 * i) for i in range(6)])
    asked = loop(world, 5, 0, pose_at(1.4))
    assert spread(world, asked, []) is not None
    read = pose_graph._pose_and_scale

    def hurt(similarity):
        pose, scale = read(similarity)
        if abs(pose[0, 3] - 0.56) < 0.05:  # keyframe 2, about where the loop leaves it
            pose[1, 3] = np.inf
        return pose, scale

    monkeypatch.setattr(pose_graph, "_pose_and_scale", hurt)
    assert spread(world, asked, []) is None
