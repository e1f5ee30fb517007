"""Keyframe messages: what they say, and that a listener's map ends up with the same observations."""

from __future__ import annotations

from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from prism_edge.backend.global_map import GlobalMap
from prism_edge.bus import codec
from prism_edge.messages import Keyframe
from prism_edge.tracking import mapping
from prism_edge.tracking.announcement import keyframe_message
from prism_edge.tracking.keyframe_culling import drop_keyframe
from prism_edge.tracking.local_map import LocalMap
from prism_edge.tracking.submaps import HOME, Parts
from tests.tracking.cloud import Cloud, check, observations, pose_at


def teller(world: LocalMap) -> SimpleNamespace:
    """What the message needs of a tracker."""
    told = SimpleNamespace(world=world, epoch=3, scale_factor=1.2, proven_after_s=0.0)
    told.shutter = SimpleNamespace(is_said=True, readout_ms=12.5)
    told.log_scale = 0.3
    told.parts = Parts()
    return told


def sent(tracker, keyframe, travelled=0.0) -> Keyframe:
    return codec.unpack(codec.pack(keyframe_message(tracker, keyframe, travelled)), Keyframe)


def test_a_message_carries_the_keyframe_and_survives_the_codec():
    cloud = Cloud(300, seed=0)
    world, _ = cloud.mapped([np.eye(4), pose_at(0.2)], parallax_deg=4.0)
    world.points.parallax_deg[:10] = 0.0
    tracker, newest = teller(world), world.newest()
    newest.twist = np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6])
    made = keyframe_message(tracker, newest, travelled=1.5, mount=pose_at(0.3, -0.1, 0.5, 0.2))
    message = codec.unpack(codec.pack(made), Keyframe)
    for f in fields(Keyframe):
        assert np.array_equal(getattr(message, f.name), getattr(made, f.name)), f.name
    assert (message.id, message.index, message.epoch, message.travelled) == (1, 10, 3, 1.5)
    assert message.log_scale == tracker.log_scale
    assert message.base_from_camera.tolist() == pose_at(0.3, -0.1, 0.5, 0.2).tolist()
    assert world.announced == 1
    assert not message.stands_in
    newest.stands_in = True
    absorbed = GlobalMap().absorb(sent(tracker, newest))
    assert absorbed.stands_in
    assert absorbed.twist.tolist() == newest.twist.tolist() == message.twist.tolist()
    assert (message.readout_ms, message.readout_said) == (12.5, True)
    keypoints, depths = world.depths_in(newest)
    assert message.depths[keypoints] == pytest.approx(depths, rel=1e-6)
    assert not message.depths[newest.points < 0].any()
    rows = world.points.rows(newest.points[keypoints])
    assert message.parallax_deg[keypoints] == pytest.approx(world.points.parallax_deg[rows])
    assert message.trust[keypoints] == pytest.approx(np.ones(len(keypoints)))
    assert not message.trust[newest.points < 0].any()
    assert message.pixels == pytest.approx(newest.features.pixels, abs=1e-3)
    assert np.array_equal(message.descriptors.view(np.uint64), newest.features.descriptors)
    assert (message.anchor, message.world_from_anchor.tolist()) == (0, np.eye(4).tolist())
    rows = world.points.rows(message.new_points)
    assert np.array_equal(message.new_positions, world.points.position[rows])
    assert np.array_equal(message.new_by, world.points.reference[rows])
    assert len(message.new_points) == int(world.points.alive.sum())


def test_a_keyframe_s_own_points_are_no_late_ones_and_its_anchor_is_the_one_before():
    world, _ = Cloud(300, seed=0).mapped([pose_at(0.3 * i) for i in range(4)])
    tracker, (*_, earlier, newest) = teller(world), world.keyframes.values()
    unseen = earlier.points[earlier.observed()]
    unseen = unseen[~np.isin(unseen, newest.points)][:2]
    newest.points[newest.observed()[:2]] = -1
    for point, row, keypoint in zip(unseen, world.points.rows(unseen), newest.free()[:2], strict=True):
        world.add_observation(int(point), int(row), newest, int(keypoint))
        world.add_observation(int(point), int(row), world.keyframes[0], int(keypoint))
    message = sent(tracker, newest)
    assert set(message.late_keyframes.tolist()) == {0}
    assert np.isin(unseen, message.points).all()
    assert (message.anchor, message.world_from_anchor[0, 3]) == (2, pytest.approx(0.6))


def test_a_message_says_which_part_of_the_map_it_is_of():
    world, _ = Cloud(50, seed=0).mapped([np.eye(4), pose_at(0.2)], parallax_deg=4.0)
    tracker, newest = teller(world), world.newest()
    assert sent(tracker, newest).part == HOME
    tracker.parts.begin(newest.id)
    assert sent(tracker, newest).part == newest.id
    assert sent(tracker, world.keyframes[0]).part == HOME
    assert not len(sent(tracker, newest).joined)
    assert tracker.parts.merge(newest.id, 0, np.array([0.3, 0.01]))
    home = sent(tracker, newest)
    assert (home.part, home.joined.tolist(), home.joined_units.tolist()) == (HOME, [[1, HOME]], [[0.3, 0.01]])
    assert not tracker.parts.merge(newest.id, 0, np.array([0.3, 0.01]))  # it was home
    assert not len(sent(tracker, newest).joined)  # said once


def test_the_first_keyframe_is_its_own_anchor():
    world = LocalMap()
    keyframe, _ = Cloud(100).keyframe(0, pose_at(0.1))
    world.add_keyframe(keyframe)
    message = sent(teller(world), keyframe)
    assert message.anchor == 0
    assert message.world_from_anchor.tolist() == pose_at(0.1).tolist()
    assert (message.points == -1).all()


def test_changes_are_told_once():
    cloud = Cloud(200, seed=1)
    world, _ = cloud.mapped([np.eye(4), pose_at(0.2)])
    tracker = teller(world)
    world.cull_points(np.arange(5))
    first = sent(tracker, world.keyframes[0])
    assert len(first.culled_points) == 5
    assert not np.isin(first.new_points, first.culled_points).any()
    again = sent(tracker, world.keyframes[1])
    for name in ("new_points", "late_points", "culled_points", "fused_from"):
        assert len(getattr(again, name)) == 0


def test_what_is_seeded_in_a_keyframe_that_was_told_of_is_told_with_the_next():
    """Its depth has come meanwhile: who hears of the points must hear of what saw them, too."""
    cloud, world, heard = Cloud(300, seed=0), LocalMap(), GlobalMap()
    keyframe, shown = cloud.keyframe(0, np.eye(4))
    world.add_keyframe(keyframe)
    tracker, half = teller(world), len(shown) // 2
    for keypoints in (np.arange(half), np.arange(half, len(shown))):
        heard.absorb(sent(tracker, keyframe))
        places = cloud.positions[shown[keypoints]]
        world.add_points(keyframe, keypoints, places, np.full(len(keypoints), 0.1), 0.0)
    following, _ = cloud.keyframe(1, pose_at(0.2))
    world.add_keyframe(following)
    heard.absorb(sent(tracker, following))
    observed = {p: seen_by[0] for p, seen_by in observations(world).items()}
    assert len(observed) == len(shown)
    assert heard.keyframes[0].observed == observed


def test_a_late_observation_of_a_fused_point_is_the_survivor_s():
    cloud = Cloud(60, seed=1)
    world, _ = cloud.mapped([np.eye(4), pose_at(0.0)])
    tracker = teller(world)
    sent(tracker, world.newest())
    first, newest = world.keyframes[0], cloud.keyframe(2, pose_at(0.0))[0]
    world.add_keyframe(newest)
    a = int(world.add_points(newest, np.array([5]), np.ones((1, 3)), np.array([0.1]), 0.0)[0])
    first.points[7], world.points.observations[first.points[7]] = -1, 1
    world.add_observation(a, int(world.points.rows(np.array([a]))[0]), first, 7)
    kept = int(first.points[3])
    world.points.observations[world.points.rows(np.array([kept]))] += 5
    world.keyframes[0].points[3] = -1
    mapping.fuse(world, np.array([a]), np.array([kept]))
    message = sent(tracker, newest)
    assert message.late_points.tolist() == [kept]
    assert (message.late_keyframes.tolist(), message.late_keypoints.tolist()) == ([0], [7])
    assert (message.fused_from.tolist(), message.fused_into.tolist()) == ([a], [kept])


def test_what_a_keyframe_that_is_gone_learnt_late_is_not_told():
    world, _ = Cloud(60, seed=1).mapped([pose_at(0.0)] * 4)
    tracker = teller(world)
    sent(tracker, world.keyframes[2])
    keyframe = world.keyframes[1]
    point = int(keyframe.points[7])
    world.drop_observations(np.array([1]), np.array([point]))
    world.add_observation(point, int(world.points.rows(np.array([point]))[0]), keyframe, 7)
    drop_keyframe(world, keyframe)
    message = sent(tracker, world.keyframes[3])
    assert message.culled_keyframes.tolist() == [1]
    assert len(message.late_points) == 0


class Listener(RuleBasedStateMachine):
    """Whatever happens to a map between messages, a listener has the same observations after each."""

    def __init__(self) -> None:
        super().__init__()
        self.cloud = Cloud(30, seed=1)
        self.world, self.heard = LocalMap(), GlobalMap()
        self.tracker = teller(self.world)
        self.rng = np.random.default_rng(0)

    @initialize(seed=st.integers(0, 1000))
    def begin(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self._insert()
        self.announce()

    def _alive(self) -> np.ndarray:
        return self.world.points.ids[self.world.points.alive]

    def _insert(self) -> None:
        number = len(self.world.keyframes)
        keyframe, _ = self.cloud.keyframe(number, pose_at(0.02 * number))
        known = self.rng.permutation(self._alive())[: len(keyframe.points) // 2]
        keyframe.points[self.rng.permutation(len(keyframe.points))[: len(known)]] = known
        self.world.add_keyframe(keyframe)

    @rule()
    def insert(self) -> None:
        """A new keyframe; more happens to the map before it is announced."""
        if self.world.announced == max(self.world.keyframes):
            self._insert()

    @rule(count=st.integers(1, 15))
    def add_points(self, count: int) -> None:
        keyframe = self.world.keyframes[int(self.rng.integers(len(self.world.keyframes)))]
        free = self.rng.permutation(keyframe.free())[:count]
        ids = self.world.add_points(
            keyframe, free, self.rng.normal(size=(len(free), 3)), np.full(len(free), 0.1), 0.0
        )
        if keyframe.id <= self.world.announced:  # seeds for a keyframe whose message has gone out
            for point, keypoint in zip(ids.tolist(), free.tolist(), strict=True):
                self.world.changes.late.append((point, keyframe.id, keypoint))

    @precondition(lambda self: len(self._alive()))
    @rule(count=st.integers(1, 15))
    def observe(self, count: int) -> None:
        keyframe = self.world.keyframes[int(self.rng.integers(len(self.world.keyframes)))]
        unseen = np.setdiff1d(self._alive(), keyframe.points)
        # Points that were made lately: fusing them before they were told is what is hard.
        points = self.rng.permutation(unseen[-2 * count :])[:count]
        for point, keypoint in zip(points.tolist(), keyframe.free().tolist(), strict=False):
            row = int(self.world.points.rows(np.array([point]))[0])
            self.world.add_observation(point, row, keyframe, keypoint)

    @precondition(lambda self: len(self._alive()) > 1)
    @rule(count=st.integers(1, 6))
    def fuse(self, count: int) -> None:
        first, second = (self.rng.choice(self._alive(), count) for _ in range(2))
        mapping.fuse(self.world, first, second)

    @precondition(lambda self: len(self._alive()))
    @rule()
    def cull(self) -> None:
        alive = self.world.points.alive
        self.world.cull_points(np.flatnonzero(alive & (self.rng.random(len(alive)) < 0.1)))

    @rule()
    def announce(self) -> None:
        newest = max(self.world.keyframes)
        if newest <= self.world.announced:
            return
        self.heard.absorb(sent(self.tracker, self.world.keyframes[newest]))
        check(self.world)
        heard = {
            p: {k: self.heard.keyframes[k].observed[p] for k in point.keyframes}
            for p, point in self.heard.points.items()
            if point.keyframes
        }
        assert heard == observations(self.world)
        for k, keyframe in self.heard.keyframes.items():
            assert set(keyframe.observed) == {p for p, seen in heard.items() if k in seen}


TestListener = Listener.TestCase
TestListener.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
