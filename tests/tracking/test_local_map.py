"""The local map: who sees what, through any sequence of operations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from prism_edge.geometry.poses import scaled, transform
from prism_edge.tracking import mapping
from prism_edge.tracking.local_map import LocalMap
from tests.tracking.cloud import Cloud, check, observations, pose_at


class MapModel(RuleBasedStateMachine):
    """Random keyframes, points, observations, fusions and removals; the counts must stay true."""

    def __init__(self) -> None:
        super().__init__()
        self.cloud = Cloud(60, seed=1)
        self.world = LocalMap()
        self.seen: dict[int, set[int]] = {}  # point -> keyframes

    def _alive(self) -> list[int]:
        return self.world.points.ids[self.world.points.alive].tolist()

    @rule(seed=st.integers(0, 1000))
    def add_keyframe(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        number = len(self.world.keyframes)
        keyframe, _ = self.cloud.keyframe(number, pose_at(0.02 * number))
        known = rng.permutation(np.array(self._alive(), np.int64))[: len(keyframe.points) // 2]
        keyframe.points[rng.permutation(len(keyframe.points))[: len(known)]] = known
        self.world.add_keyframe(keyframe)
        for p in known.tolist():
            self.seen[p].add(number)

    @precondition(lambda self: self.world.keyframes)
    @rule(seed=st.integers(0, 1000), count=st.integers(0, 20))
    def add_points(self, seed: int, count: int) -> None:
        rng = np.random.default_rng(seed)
        keyframe = self.world.keyframes[int(rng.integers(len(self.world.keyframes)))]
        free = rng.permutation(keyframe.free())[:count]
        positions, sigmas = rng.normal(size=(len(free), 3)), np.full(len(free), 0.1)
        ids = self.world.add_points(keyframe, free, positions, sigmas, 0.0)
        assert not set(ids.tolist()) & set(self.seen), "ids are never used twice"
        self.seen |= {p: {keyframe.id} for p in ids.tolist()}

    @precondition(lambda self: self.world.keyframes and self._alive())
    @rule(seed=st.integers(0, 1000))
    def observe(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        point = int(rng.choice(self._alive()))
        keyframe = self.world.keyframes[int(rng.integers(len(self.world.keyframes)))]
        if keyframe.id in self.seen[point] or not len(keyframe.free()):
            return
        row = int(self.world.points.rows(np.array([point]))[0])
        self.world.add_observation(point, row, keyframe, int(keyframe.free()[0]))
        self.seen[point].add(keyframe.id)

    @precondition(lambda self: self._alive())
    @rule(seed=st.integers(0, 1000))
    def cull(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        rows = np.flatnonzero(self.world.points.alive & (rng.random(len(self.world.points)) < 0.2))
        gone = self.world.points.ids[rows].tolist()
        self.world.cull_points(rows)
        for p in gone:
            del self.seen[p]
        for keyframe in self.world.keyframes.values():
            assert not set(gone) & set(keyframe.points.tolist())

    @precondition(lambda self: self._alive())
    @rule(seed=st.integers(0, 1000))
    def drop(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        pairs = [(k, p) for p, ks in self.seen.items() for k in ks if rng.random() < 0.2]
        pairs += [(99, 10**6), (0, 10**6)]  # of a keyframe and a point that were never there
        keyframes, points = np.array(pairs, np.int64).T
        self.world.drop_observations(keyframes, points)
        for k, p in pairs:
            self.seen.get(p, set()).discard(k)
        for p in {p for _, p in pairs if p in self.seen and len(self.seen[p]) < 2}:
            del self.seen[p]

    @precondition(lambda self: len(self._alive()) > 1)
    @rule(seed=st.integers(0, 1000), count=st.integers(1, 6))
    def fuse(self, seed: int, count: int) -> None:
        rng = np.random.default_rng(seed)
        first, second = (rng.choice(self._alive(), count) for _ in range(2))
        before, told = set(self._alive()), len(self.world.changes.fused)
        mapping.fuse(self.world, first, second)
        wanted = {frozenset(pair) for pair in zip(first.tolist(), second.tolist(), strict=True)}
        for old, kept in self.world.changes.fused[told:]:
            assert frozenset((old, kept)) in wanted
            assert len(self.seen[kept]) >= len(self.seen[old]) or kept in second
            self.seen[kept] |= self.seen.pop(old)
        assert before - set(self._alive()) == {old for old, _ in self.world.changes.fused[told:]}

    @invariant()
    def counts_are_true(self) -> None:
        check(self.world)
        assert {p: set(ks) for p, ks in observations(self.world).items()} == {
            p: ks for p, ks in self.seen.items() if ks
        }
        assert set(self._alive()) == set(self.seen)


TestLocalMap = MapModel.TestCase
TestLocalMap.settings = settings(max_examples=25, stateful_step_count=25, deadline=None)


@pytest.fixture
def world():
    cloud = Cloud(400, seed=2)
    return cloud.mapped([pose_at(0.3 * i) for i in range(4)])[0]


def test_covisible_ranks_by_shared_points(world):
    newest = world.newest()
    shared = {
        k: len(np.intersect1d(newest.points[newest.observed()], other.points[other.observed()]))
        for k, other in world.keyframes.items()
        if k != newest.id
    }
    assert [k.id for k in world.covisible(newest, 10)] == sorted(shared, key=lambda k: -shared[k])
    assert len(world.covisible(newest, 2)) == 2


def test_centres_are_where_the_cameras_stand_in_the_order_of_their_numbers(world):
    world.keyframes = {k: world.keyframes[k] for k in (2, 0, 3, 1)}
    numbers, centres = world.centres()
    assert numbers.tolist() == [0, 1, 2, 3]
    assert centres.tolist() == [world.keyframes[k].world_from_camera[:3, 3].tolist() for k in range(4)]


def test_a_keyframe_s_newest_point_is_among_what_it_may_see(world):
    for keyframe in world.keyframes.values():
        newest = keyframe.points[[keyframe.points.argmax()]]
        assert world.votes(newest)[keyframe.id] == 1
    world.cull_points(world.points.rows(newest))
    assert all(newest[0] not in keyframe.points for keyframe in world.keyframes.values())


def test_votes_count_the_points_a_keyframe_sees(world):
    ids = world.points.ids[::3].copy()
    expected = {k: int(np.isin(keyframe.points, ids).sum()) for k, keyframe in world.keyframes.items()}
    assert world.votes(ids) == expected
    assert world.votes(np.zeros(0, np.int64)) == {}


def test_the_nearest_keyframe_sees_most_of_a_view_and_is_the_newest_of_several():
    world, _ = Cloud(400, seed=0).mapped([pose_at(0.3 * i) for i in range(5)])
    view = world.keyframes[1].points.copy()
    assert len(world.votes(view[view >= 0])) == 5, "newer ones see some of it too"
    assert world.nearest(view) is world.keyframes[1]
    same, _ = Cloud(400, seed=0).mapped([pose_at()] * 3)
    assert same.nearest(same.keyframes[0].points) is same.keyframes[2]
    assert world.nearest(np.full(5, -1)) is None


def test_rows_seen_by_are_distinct_and_limited(world):
    keyframes = [world.keyframes[2], world.keyframes[0]]
    rows = world.rows_seen_by(keyframes, 10_000)
    expected = {p for k in keyframes for p in k.points[k.observed()].tolist()}
    assert len(rows) == len(expected)
    assert set(world.points.ids[rows].tolist()) == expected
    few = world.rows_seen_by(keyframes, 50)
    assert len(few) == 50
    assert np.isin(world.points.ids[few], world.keyframes[2].points).all()
    assert len(world.rows_seen_by([], 10)) == 0


def test_depths_are_along_the_axis_of_the_camera(world):
    keyframe = world.keyframes[1]
    keypoints, depths = world.depths_in(keyframe)
    local = world.points.position[world.points.rows(keyframe.points[keypoints])] - (0.3, 0, 0)
    assert depths == pytest.approx(local[:, 2])
    assert world.median_depth(keyframe) == pytest.approx(np.median(local[:, 2]))


def test_a_keyframe_that_sees_nothing_has_depth_one():
    world = LocalMap()
    keyframe, _ = Cloud(50).keyframe(0, np.eye(4))
    world.add_keyframe(keyframe)
    assert world.median_depth(keyframe) == 1.0


def test_points_look_as_they_did_last(world):
    newest = world.newest()
    keypoints = newest.observed()
    rows = world.points.rows(newest.points[keypoints])
    offset = newest.world_from_camera[:3, 3] - world.points.position[rows]
    distance = np.linalg.norm(offset, axis=1)
    assert world.points.distance[rows] == pytest.approx(distance)
    assert world.points.direction[rows] == pytest.approx(offset / distance[:, None])
    assert np.array_equal(world.points.octave[rows], newest.features.octaves[keypoints])


def test_points_know_from_where_they_were_seen_last_once_their_map_was_turned_and_scaled():
    world, _ = Cloud(200).mapped([pose_at(0.1 * i) for i in range(4)])
    table, motion = world.points, pose_at(3.0, 0.5, -1.0, 0.0, 2.5, 0.0)
    for keyframe in world.keyframes.values():
        keyframe.world_from_camera = motion @ scaled(keyframe.world_from_camera, 0.5)
    table.position[:] = transform(motion, 0.5 * table.position)
    world.look_anew()
    for row, point in enumerate(table.ids.tolist()):
        last = max(k for k, keyframe in world.keyframes.items() if point in keyframe.points)
        keyframe = world.keyframes[last]
        keypoint = int(np.flatnonzero(keyframe.points == point)[0])
        way = keyframe.world_from_camera[:3, 3] - table.position[row]
        assert table.distance[row] == pytest.approx(np.linalg.norm(way))
        assert table.direction[row] * table.distance[row] == pytest.approx(way)
        assert table.octave[row] == keyframe.features.octaves[keypoint]
        assert (table.descriptor[row] == keyframe.features.descriptors[keypoint]).all()


def test_an_empty_map_has_nothing_to_look_at():
    LocalMap().look_anew()


def test_keyframes_that_share_less_than_fifteen_points_are_no_neighbours():
    world, _ = Cloud(200).mapped([np.eye(4), pose_at(0.05), pose_at(0.1)])
    first, few, enough = world.keyframes.values()
    for keyframe, left in ((few, 14), (enough, 15)):
        shared = np.flatnonzero(np.isin(keyframe.points, first.points) & (keyframe.points >= 0))
        keyframe.points[shared[left:]] = -1
    assert world.covisible(first, 5) == [enough]


def test_what_lies_behind_a_keyframe_has_no_part_in_how_deep_it_sees():
    world, _ = Cloud(200).mapped([np.eye(4)])
    keyframe, table = world.keyframes[0], world.points
    rows = table.rows(keyframe.points[keyframe.observed()])
    table.position[rows[::2], 2] *= -1.0
    assert world.median_depth(keyframe) == pytest.approx(np.median(table.position[rows[1::2], 2]))
