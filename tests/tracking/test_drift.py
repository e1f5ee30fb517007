"""Drift in the map: what it grows by from keyframe to keyframe, and what undoes it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from prism_edge.geometry.poses import from_rt, so3_exp
from prism_edge.tracking.drift import NO_DRIFT, Drift, Walk
from tests.tracking.cloud import pose_at
from tests.tracking.drifting import CONFIG, World, result, world_of


def test_variance_grows_with_the_metres_and_the_radians():
    drift = Drift(CONFIG)
    world = World(drift, log_scale=np.log(2.0))
    world.walk_to(0, np.eye(4), [])
    world.walk_to(1, pose_at(0, 0, 3.0), [0])
    world.walk_to(2, from_rt(so3_exp(np.array([0, 0.5, 0])), np.array([0, 0, 3.0])), [1])
    expected = Walk(0.02**2 * 6.0, 0.01**2 * 0.5)
    for walk in (drift.total, world.drift_at(2)):
        assert walk.sigmas() == pytest.approx(expected.sigmas())
    assert world.drift_at(0) == NO_DRIFT
    assert np.diag(expected.covariance()) == pytest.approx([24e-4] * 3 + [0.5e-4] * 3)


def test_a_frame_has_its_keyframe_s_drift_and_the_way_from_there():
    drift = Drift(CONFIG)
    world = World(drift)
    world.walk_to(0, np.eye(4), [])
    world.walk_to(1, pose_at(4.0), [0])
    drift.advance(world.last, result(pose_at(5.0), 1, pose_at(1.0)), 0.0)
    assert drift.here.metres2 == pytest.approx(0.02**2 * 5.0)


def test_coming_back_to_what_is_known_undoes_the_drift_of_the_map_and_not_of_odom():
    drift = Drift(CONFIG)
    world = World(drift)
    for n, x in enumerate((0.0, 2.0, 4.0, 2.0)):
        world.walk_to(n, pose_at(x), [n - 1] if n else [])
    world.walk_to(4, pose_at(0.5), [3, 0])
    assert world.drift_at(3).metres2 == pytest.approx(0.02**2 * 6.0)
    assert world.drift_at(4).metres2 == pytest.approx(0.02**2 * 0.5)
    assert drift.total.metres2 == pytest.approx(0.02**2 * 7.5)


@pytest.mark.parametrize("forward", [True, False])
def test_a_loop_makes_both_ends_and_what_is_around_them_surer(forward):
    drift = Drift(CONFIG)
    world = World(drift)
    corners = [(0, 0), (4, 0), (8, 0), (8, 4), (4, 4), (0, 4), (0, 1)]
    for n, (x, z) in enumerate(corners):
        world.walk_to(n, pose_at(x, 0, z), [n - 1] if n else [])
    assert world.drift_at(6).metres2 == pytest.approx(0.02**2 * 23.0)
    ends = (6, 0) if forward else (0, 6)
    drift.close(world, SimpleNamespace(loop_query=ends[0], loop_candidate=ends[1]), 0.0)
    ways = [world.drift_at(n).metres2 / 0.02**2 for n in range(7)]
    assert ways == pytest.approx([0, 4, 8, 12, 8, 4, 1])
    drift.close(world, SimpleNamespace(loop_query=99, loop_candidate=0), 0.0)  # long gone: nothing happens
    assert world.drift_at(6).metres2 == pytest.approx(0.02**2)


def test_a_loop_leads_on_where_keyframes_know_only_those_that_came_later():
    """Ten newer ones have each been put before all that a keyframe had known of the way to it."""
    drift = Drift(CONFIG)
    world = World(drift)
    for n, (x, z) in enumerate([(0, 0), (4, 0), (8, 0), (8, 4), (4, 4), (0, 4), (0, 1)]):
        world.walk_to(n, pose_at(x, 0, z), [n - 1] if n else [])
    for n, keyframe in world.keyframes.items():
        keyframe.neighbours = [n + 1] if n < 6 else [5, 99]  # one of which has been culled
    drift.close(world, SimpleNamespace(loop_query=6, loop_candidate=0), 0.0)
    ways = [world.drift_at(n).metres2 / 0.02**2 for n in range(7)]
    assert ways == pytest.approx([0, 4, 8, 12, 8, 4, 1])


def test_a_shorter_way_that_turns_more_makes_no_keyframe_less_sure_of_its_turn():
    drift = Drift(CONFIG)
    world = World(drift)
    world.walk_to(0, np.eye(4), [])
    world.walk_to(1, pose_at(9.0), [0])
    world.walk_to(2, from_rt(so3_exp(np.array([0, 2.0, 0])), np.array([0, 0, 1.0])), [1])
    world.walk_to(3, pose_at(0.5, 0, 1.0), [2])
    turn = world.drift_at(2).radians2
    drift._keyframes[0] = Walk(0.0, 1.0)  # surer of its place than of its turn
    drift.close(world, SimpleNamespace(loop_query=2, loop_candidate=0), 0.0)
    assert world.drift_at(2).metres2 == pytest.approx(0.02**2 * 1.0)
    assert world.drift_at(2).radians2 == pytest.approx(turn)


def test_a_keyframe_that_shares_nothing_has_the_whole_walk():
    drift = Drift(CONFIG)
    world = World(drift)
    for number, neighbours in enumerate(([], [0], [])):
        world.walk_to(number, pose_at(3.0 * number), neighbours)
    assert drift._keyframes[2] == drift.total
    assert drift.total.metres2 == pytest.approx(0.02**2 * 6.0)


def wandering(drift: Drift, keyframes: int, seed: int) -> World:
    """Keyframes here and there in one room, each knowing the few before it."""
    world, rng = World(drift), np.random.default_rng(seed)
    for n in range(keyframes):
        pose = from_rt(so3_exp(rng.normal(0, 0.5, 3)), rng.uniform(-2, 2, 3))
        world.walk_to(n, pose, list(range(max(0, n - 4), n))[::-1])
    return world


@pytest.mark.parametrize("seed", range(5))
def test_a_loop_leaves_the_least_of_all_ways_from_what_was_known(seed):
    drift = Drift(CONFIG)
    world = wandering(drift, 40, seed)
    before = [world.drift_at(n).metres2 for n in range(40)]
    drift.close(world, SimpleNamespace(loop_query=39, loop_candidate=1), 0.0)
    places = np.array([world.keyframes[n].world_from_camera[:3, 3] for n in range(40)])
    ways = np.array(before)
    for _ in range(40):  # Bellman and Ford: until nothing changes, from what was known
        for a in range(40):
            for b in [*world.keyframes[a].neighbours, *{1: [39], 39: [1]}.get(a, [])]:
                ways[b] = min(ways[b], ways[a] + 0.02**2 * np.linalg.norm(places[a] - places[b]))
    assert [world.drift_at(n).metres2 for n in range(40)] == pytest.approx(ways.tolist())
    assert world.drift_at(39).metres2 < before[39]


def test_a_loop_in_a_large_map_goes_through_no_keyframe_s_surroundings_twice(monkeypatch):
    drift = Drift(CONFIG)
    world = wandering(drift, 300, 1)
    gone_through, between = [], Drift._between

    def counted(self, first, *rest):
        gone_through.append(first.id)
        return between(self, first, *rest)

    monkeypatch.setattr(Drift, "_between", counted)
    drift.close(world, SimpleNamespace(loop_query=299, loop_candidate=0), 0.0)
    assert 100 < len(gone_through) <= 300 + 2  # and the two ends, of each other


def test_a_new_map_begins_without_drift_and_odom_goes_on():
    drift = Drift(CONFIG)
    world = World(drift)
    world.walk_to(0, np.eye(4), [])
    world.walk_to(1, pose_at(4.0), [0])
    world.keyframes.clear()
    world.walk_to(7, np.eye(4), [])
    assert world.drift_at(7) == NO_DRIFT
    assert drift.total.metres2 == pytest.approx(0.02**2 * 8.0)


def test_a_map_that_takes_another_s_place_is_as_far_off_as_that_was_where_it_begins():
    """Its first camera is where the last one was, in the same frame."""
    drift = Drift(CONFIG)
    world = World(drift)
    world.walk_to(0, np.eye(4), [])
    world.walk_to(1, pose_at(4.0), [0])
    drift.advance(pose_at(4.0), result(pose_at(5.0), 1, pose_at(1.0)), 0.0)
    world.keyframes.clear()
    drift.add_keyframe(world_of(world, 7, pose_at(5.0)), world.keyframes[7], 0.0)
    assert world.drift_at(7).metres2 == pytest.approx(0.02**2 * 5.0)
    world.last = pose_at(5.0)
    world.walk_to(8, pose_at(6.0), [7])
    assert world.drift_at(8).metres2 == pytest.approx(0.02**2 * 6.0), "and no more than was walked in all"


def test_what_begins_a_part_was_placed_by_one_image_whatever_was_seen_before():
    drift = Drift(CONFIG)
    world = World(drift)
    world.walk_to(0, np.eye(4), [], parallax=10.0)
    drift.total += Walk(1.0, 1.0)  # a way that nobody saw
    for number, angle, neighbours in ((1, 0.1, [0]), (2, 0.5, [])):
        world.walk_to(number, from_rt(so3_exp(np.array([0.0, angle, 0.0])), np.zeros(3)), neighbours, 10.0)
    drift.close(world, SimpleNamespace(loop_query=2, loop_candidate=1), 0.0)
    assert world.drift_at(2).radians2 == pytest.approx(0.02**2 * 0.5)


def test_a_frame_s_way_from_its_keyframe_is_off_by_what_that_saw():
    drift = Drift(CONFIG)
    world = World(drift)
    world.walk_to(0, np.eye(4), [])
    drift.total += Walk(1.0, 1.0)  # no bound
    turned = from_rt(so3_exp(np.array([0.0, 0.5, 0.0])), np.zeros(3))
    drift.advance(np.eye(4), replace(result(turned, 0, turned), parallax_deg=10.0), 0.0)
    assert drift.here.radians2 == pytest.approx(0.02**2 * 0.5)


def test_keyframes_of_an_earlier_life_drifted_as_the_crow_flies():
    drift = Drift(CONFIG)
    world = World(drift)
    world.keyframes[3] = SimpleNamespace(id=3, world_from_camera=pose_at(9.0), neighbours=[])
    world.walk_to(4, pose_at(10.0), [3])
    assert world.drift_at(4).metres2 == pytest.approx(0.02**2 * 10.0)


def test_a_frame_at_a_keyframe_of_an_earlier_life_is_as_sure_however_long_the_way_was():
    drift, offset = Drift(CONFIG), pose_at(0.5)
    for way in (3.0, 300.0):
        drift.advance(np.eye(4), result(pose_at(way), 1, np.eye(4)), 0.0)
        drift.advance(None, result(pose_at(4.0) @ offset, 7, offset), 0.0)
        assert drift.here.metres2 == pytest.approx(0.02**2 * 4.5)
    assert drift.total.metres2 == pytest.approx(0.02**2 * 303.0)


def test_another_map_s_keyframes_are_not_taken_for_those_of_the_same_number():
    drift = Drift(CONFIG)
    world = World(drift)
    for number in range(3):
        world.walk_to(number, pose_at(0.1 * number), [number - 1] if number else [])
    drift.local_sigma = 0.1
    drift.forget()
    drift.advance(None, result(pose_at(60.0), 2, np.eye(4)), 0.0)
    assert drift.here.metres2 == pytest.approx(0.02**2 * 60.0)
    assert drift.total.metres2 == pytest.approx(0.02**2 * 0.2)


def test_culled_keyframes_are_forgotten():
    drift = Drift(CONFIG)
    world = World(drift)
    for n in range(100):
        world.walk_to(n, pose_at(0.1 * n, 0.1 * (n % 2)), [n - 1] if n else [])
        for old in [k for k in world.keyframes if k < n - 5]:
            del world.keyframes[old]
    assert len(drift._keyframes) < 40
    assert world.drift_at(99).metres2 == pytest.approx(0.02**2 * 9.9 * np.sqrt(2.0)), "as it went"


def test_points_that_are_seen_better_since_leave_keyframes_where_they_are():
    """What a keyframe was off by as it was made, before its points had parallax, its neighbours are, too."""
    drift = Drift(CONFIG)
    world = World(drift)
    world.walk_to(0, np.eye(4), [])
    for number, angle, parallax in ((1, 0.5, 0.5), (2, 0.6, 10.0), (3, 0.1, 10.0)):
        turned = from_rt(so3_exp(np.array([0.0, angle, 0.0])), np.zeros(3))
        world.walk_to(number, turned, list(range(number)), parallax)
    early, later = 0.02**2, 0.001**2  # a radian
    assert world.drift_at(1).radians2 == pytest.approx(early * 0.5)
    assert world.drift_at(2).radians2 == pytest.approx(early * 0.5 + later * 0.1)
    assert world.drift_at(3).radians2 == pytest.approx(early * 0.1), "beside the first, which began the map"


def test_drift_in_the_map_is_no_more_than_the_walk_since_it_began():
    drift = Drift(CONFIG)
    before = World(drift)
    for number, x in enumerate((0.0, 5.0)):  # a map that is given up, as by `ctl reset`
        before.walk_to(number, pose_at(x), [number - 1] if number else [])
    drift.forget()
    world = World(drift)
    for number, x in enumerate((0.0, 1.0, 3.0)):
        world.walk_to(number, pose_at(x), [number - 1] if number else [])
    drift.advance(pose_at(3.0), result(pose_at(4.0), 0, pose_at(40.0)), 0.0)
    assert drift.here.metres2 == pytest.approx(0.02**2 * 4.0)


@pytest.mark.parametrize(("made", "now"), [(10.0, 0.5), (0.5, 10.0)])
def test_the_way_from_a_keyframe_counts_under_the_lesser_parallax_of_its_two_ends(made, now):
    """A frame that sees hardly any is as badly placed beside a keyframe that saw much, and the reverse."""
    drift = Drift(replace(CONFIG, drift_of_motion=0.05))
    world = World(drift)
    world.walk_to(0, np.eye(4), [])
    world.walk_to(1, pose_at(1.0), [0], made)
    drift.total += Walk(9.0, 9.0)  # what `odom` has walked bounds neither
    there = world.drift_at(1)
    drift.advance(None, replace(result(pose_at(1.8), 1, pose_at(0.8)), parallax_deg=now), 0.0)
    share = 0.05 / min(made, now)
    step = (0.02**2 + share**2 * 0.8) * 0.8
    assert drift.here.metres2 == pytest.approx(there.metres2 + step)
