"""The backend's map: what keyframe messages make of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend.global_map import GlobalMap, GlobalPoint
from prism_edge.backend.pose_graph import Similarity, apply
from prism_edge.geometry.poses import inverse, se3_log, transform
from prism_edge.messages import HOME
from tests.backend.world import Teller, check, poses_of, quiet
from tests.tracking.cloud import pose_at

POSES = [pose_at(0.2 * i) for i in range(5)]


@pytest.fixture
def told():
    teller, world = Teller(), GlobalMap()
    messages = [teller.keyframe(pose) for pose in POSES]
    for message in messages:
        world.absorb(message)
    return world, teller, messages


def test_everything_told_is_there(told):
    world, teller, messages = told
    check(world)
    for message in messages:
        keyframe = world.keyframes[message.id]
        assert keyframe.world_from_camera == pytest.approx(message.world_from_camera, abs=1e-6)
        assert keyframe.observed == {int(p): i for i, p in enumerate(message.points)}
        assert keyframe.pixels == pytest.approx(message.pixels)
    for p, point in world.points.items():
        assert point.position == pytest.approx(teller.cloud.positions[p], abs=1e-5)


def test_late_observations_reach_earlier_keyframes(told):
    world, _, messages = told
    point = int(messages[0].points[3])
    world.drop_observation(1, point)
    late = {"late_points": [point, 10**6], "late_keyframes": [1, 1], "late_keypoints": [7, 8]}
    world.absorb(quiet(messages[-1], **late))
    assert world.keyframes[1].observed[point] == 7
    assert 1 in world.points[point].keyframes
    assert 10**6 not in world.points
    check(world)


def test_a_keypoint_shows_one_point_that_which_the_tracker_says(told):
    """A loop has put a point where the tracker, which has not heard of it, puts another."""
    world, _, messages = told
    _, said, looped = messages[1].points[:3].tolist()
    others = world.points[looped].keyframes - {1}
    for point in (said, looped):
        world.drop_observation(1, point)
    world.observe(1, looped, 1)
    late = {"late_points": [said], "late_keyframes": [1], "late_keypoints": [1]}
    world.absorb(quiet(messages[-1], **late))
    assert world.keyframes[1].observed[said] == 1
    assert looped not in world.keyframes[1].observed
    assert world.points[looped].keyframes == others
    check(world)


def test_a_point_that_gives_way_at_its_only_keypoint_is_gone(told):
    world, _, messages = told
    said, lonely = int(messages[4].points[0]), 10**6
    world.drop_observation(4, said)
    world.points[lonely] = GlobalPoint(np.zeros(3))
    world.observe(4, lonely, 0)
    late = {"late_points": [said], "late_keyframes": [4], "late_keypoints": [0]}
    world.absorb(quiet(messages[-1], **late))
    assert lonely not in world.points
    check(world)


def test_a_point_that_moved_to_another_keypoint_does_not_give_way_at_the_first(told):
    world, _, messages = told
    (moved, other), later = messages[1].points[:2].tolist(), len(messages[1].points) - 1
    late = {"late_points": [moved, other], "late_keyframes": [1, 1], "late_keypoints": [later, 0]}
    world.absorb(quiet(messages[-1], **late))
    assert (world.keyframes[1].observed[moved], world.keyframes[1].observed[other]) == (later, 0)
    check(world)


def test_what_is_seen_late_of_a_point_that_became_another_is_seen_of_that(told):
    world, _, messages = told
    gone, kept = messages[0].points[:2].tolist()
    for point in (gone, kept):
        world.drop_observation(1, point)
    world.fuse(gone, kept)
    late = {"late_points": [gone], "late_keyframes": [1], "late_keypoints": [7]}
    world.absorb(quiet(messages[-1], **late))
    assert world.keyframes[1].observed[kept] == 7
    check(world)


def test_what_is_seen_late_by_or_of_what_is_not_here_changes_nothing(told):
    """A keyframe that was culled, a point that nobody has told of."""
    world, _, messages = told
    before = {k: dict(keyframe.observed) for k, keyframe in world.keyframes.items()}
    late = {"late_points": [int(messages[0].points[0]), 10**6], "late_keyframes": [77, 1]}
    world.absorb(quiet(messages[-1], **late, late_keypoints=[0, 0]))
    assert {k: world.keyframes[k].observed for k in before} == before
    check(world)


def test_of_two_points_seen_late_at_one_keypoint_the_last_stays(told):
    world, _, messages = told
    late = {"late_points": messages[1].points[:2].tolist(), "late_keyframes": [1, 1]}
    world.absorb(quiet(messages[-1], **late, late_keypoints=[7, 7]))
    assert [p for p, i in world.keyframes[1].observed.items() if i == 7] == late["late_points"][1:]
    check(world)


def test_culled_points_are_gone_everywhere(told):
    world, _, messages = told
    culled = messages[2].points[:30].tolist()
    world.absorb(quiet(messages[-1], culled_points=[*culled, 10**6]))
    assert not set(culled) & set(world.points)
    check(world)


def test_fused_points_pass_on_what_saw_them(told):
    world, _, messages = told
    a, b = messages[0].points[:2].tolist()
    only_a = {k for k in world.points[a].keyframes if b not in world.keyframes[k].observed}
    saw = world.points[a].keyframes | world.points[b].keyframes
    at = {k: world.keyframes[k].observed[b] for k in world.points[b].keyframes}
    world.absorb(quiet(messages[-1], fused_from=[a], fused_into=[b]))
    assert a not in world.points
    assert world.points[b].keyframes == saw
    for k in saw - only_a:
        assert world.keyframes[k].observed[b] == at[k], "what saw the kept one keeps its keypoint"
    check(world)


def test_a_chain_of_fusions_through_a_point_never_told(told):
    world, _, messages = told
    a, c = messages[0].points[:2].tolist()
    saw = world.points[a].keyframes | world.points[c].keyframes
    world.absorb(quiet(messages[-1], fused_from=[a, 777_777], fused_into=[777_777, c]))
    assert a not in world.points
    assert 777_777 not in world.points
    assert world.points[c].keyframes == saw
    check(world)


def test_a_culled_keyframe_is_carried_by_one_that_stayed(told):
    world, _, messages = told
    world.absorb(quiet(messages[-1], culled_keyframes=[2]))
    check(world)
    assert 2 not in world.keyframes
    assert poses_of(world)[2] == pytest.approx(POSES[2], abs=1e-6)
    ((_, anchor, _),) = world.carried.numbers.tolist()
    motion = pose_at(1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    world.keyframes[anchor].world_from_camera = motion @ world.keyframes[anchor].world_from_camera
    assert poses_of(world)[2] == pytest.approx(motion @ POSES[2], abs=1e-6)
    # Its anchor may go as well.
    world._forget_keyframe(anchor)
    assert poses_of(world)[2] == pytest.approx(motion @ POSES[2], abs=1e-6)
    assert set(poses_of(world)) >= {0, 1, 2, 3, 4}


def test_a_culled_keyframe_hangs_on_the_one_that_shared_most_with_it(told):
    world, _, messages = told
    shared = {m.id: len(np.intersect1d(m.points, messages[0].points)) for m in messages[1:]}
    world._forget_keyframe(0)
    assert world.carried.numbers[0, 1] == max(shared, key=shared.get)


def test_what_the_new_keyframe_sees_outlives_a_culled_one(told):
    """A point of a culled keyframe and one other is seen by two again: the tracker kept it too."""
    world, teller, _ = told
    message = teller.keyframe(POSES[0])
    point = next(
        p for p, seen in world.points.items() if seen.keyframes == {0, 1} and p in message.points.tolist()
    )
    world.absorb(replace(message, culled_keyframes=np.array([1])))
    assert world.points[point].keyframes == {0, message.id}
    check(world)


@pytest.mark.parametrize("bound", [0, 1, 3])
def test_only_the_last_culled_are_remembered(bound):
    teller, world = Teller(), GlobalMap(bound)
    for i in range(8):
        world.absorb(teller.keyframe(pose_at(0.1 * i)))
    for culled in (5, 2, 4, 1, 3):
        world._forget_keyframe(culled)
    remembered = [2, 4, 1, 3][4 - bound :]
    assert world.carried.ids.tolist() == remembered
    assert set(poses_of(world)) == {0, 6, 7, *remembered}
    assert set(world.carried.numbers[:, 1].tolist()) <= world.keyframes.keys()
    for k in remembered:
        assert poses_of(world)[k] == pytest.approx(teller.poses[k], abs=1e-5)
    check(world)


def test_points_seen_once_go_with_a_wrong_observation(told):
    world, _, _ = told
    point = next(p for p, seen in world.points.items() if len(seen.keyframes) == 2)
    first, second = world.points[point].keyframes
    world.drop_observation(first, point)
    assert point not in world.points
    assert point not in world.keyframes[second].observed
    world.drop_observation(first, point)
    world.drop_observation(99, 10**6)
    check(world)


def test_covisible_counts_shared_points(told):
    world, _, messages = told
    expected = {
        m.id: len(np.intersect1d(m.points, messages[-1].points)) for m in messages[:-1]
    }
    assert dict(world.covisible(4)) == expected
    counts = [n for _, n in world.covisible(4)]
    assert counts == sorted(counts, reverse=True)


def test_what_a_tracker_placed_before_it_was_corrected_is_put_right(told):
    """Its world lags behind by a rigid motion: keyframe and new points land where they truly are."""
    world, teller, _ = told
    lag = pose_at(0.15, -0.1, 0.05, 0.02, -0.03, 0.01)
    message = teller.keyframe(pose_at(-0.4, 0.2, -0.3), correction=lag)
    assert len(message.new_points) > 5
    added = world.absorb(message)
    assert np.abs(se3_log(inverse(teller.poses[-1]) @ added.world_from_camera)).max() < 1e-3
    for p in message.new_points.tolist():
        assert world.points[p].position == pytest.approx(teller.cloud.positions[p], abs=5e-3)


def test_new_points_of_an_earlier_keyframe_come_beside_it_and_not_beside_the_new_one(told):
    """The new one is where it fits best, which noise moves; the keyframe before is known where it is."""
    world, teller, _ = told
    lag, slip = pose_at(0.15, -0.1, 0.05, 0.02, -0.03, 0.01), pose_at(0.02, 0.0, 0.01)
    message = teller.keyframe(pose_at(0.9), correction=lag)
    mine = [i for i, p in enumerate(message.points.tolist()) if p in world.points]
    at = world.keyframes[4].world_from_camera @ (0.1, -0.2, 2.0, 1.0)
    told_at = (lag @ at)[None, :3]
    world.absorb(
        replace(
            message,
            world_from_camera=message.world_from_camera @ slip,
            points=np.where(np.isin(np.arange(len(message.points)), mine), message.points, -1),
            new_points=np.array([9000, 9001]),
            new_positions=np.concatenate([told_at, told_at]),
            new_by=np.array([4, 5]),
        )
    )
    assert world.points[9000].position == pytest.approx(at[:3], abs=1e-6)
    assert np.linalg.norm(world.points[9001].position - at[:3]) > 0.015


def test_a_point_goes_with_who_made_it_then_with_the_oldest_that_sees_it(told):
    world, _, messages = told
    point = min(set.intersection(*(set(messages[k].points.tolist()) for k in (1, 2, 3))))
    viewers = sorted(world.points[point].keyframes)
    world.absorb(quiet(messages[-1], new_points=[point], new_positions=np.zeros((1, 3)), new_by=[2]))
    assert world.carrier(point) == 2 != viewers[0]
    world.absorb(quiet(messages[-1], id=6, culled_keyframes=[2]))
    assert world.carrier(point) == viewers[0]


def test_without_common_points_the_keyframe_before_says_where(told):
    world, _, messages = told
    lag = pose_at(0.5, 0.0, 0.0, 0.0, 0.2)
    true = pose_at(1.0, 0.5)
    message = quiet(
        messages[-1],
        world_from_camera=lag @ true,
        world_from_anchor=lag @ messages[-1].world_from_camera,
    )
    assert world.absorb(message).world_from_camera == pytest.approx(true, abs=1e-5)


def test_points_that_matured_are_told_again_and_move(told):
    world, teller, messages = told
    point = int(messages[0].points[0])
    place = teller.cloud.positions[point] + (0.0, 0.0, 0.3)
    world.absorb(quiet(messages[-1], new_points=[point], new_positions=place[None], new_by=[2]))
    assert world.points[point].position == pytest.approx(place)
    assert len(world.points[point].keyframes) >= 2
    check(world)


def test_a_world_told_from_the_middle_on_still_works():
    """A backend that was started anew hears of points it never saw."""
    teller = Teller()
    messages = [teller.keyframe(pose) for pose in POSES]
    world = GlobalMap()
    for message in messages[2:]:
        world.absorb(message)
    check(world)
    assert world.keyframes[4].world_from_camera == pytest.approx(POSES[4], abs=1e-6)
    moved = transform(POSES[4], np.zeros((1, 3)))[0]
    assert moved == pytest.approx([0.8, 0.0, 0.0])


def test_a_pose_that_fits_few_of_the_common_points_is_not_believed(told):
    """Wrongly matched, they say nothing: the keyframe comes in beside the one before it."""
    world, teller, messages = told
    lag, true = pose_at(0.15, -0.1, 0.05, 0.02, -0.03, 0.01), pose_at(0.9)
    message = teller.keyframe(true, correction=lag)
    common = [i for i, p in enumerate(message.points.tolist()) if p in messages[-1].points.tolist()][:20]
    scrambled = np.random.default_rng(0).uniform((0, 0), (640, 480), (20, 2)).astype(np.float32)
    assert len(common) == 20
    few = replace(
        message,
        pixels=scrambled,
        octaves=message.octaves[common],
        descriptors=message.descriptors[common],
        points=message.points[common],
        depths=message.depths[common],
        parallax_deg=message.parallax_deg[common],
        new_points=message.new_points[:0],
        new_positions=message.new_positions[:0],
        new_by=message.new_by[:0],
    )
    assert world.absorb(few).world_from_camera == pytest.approx(true, abs=1e-5)


def test_of_two_keypoints_that_show_one_point_now_that_of_the_name_that_stays_keeps_it(told):
    world, teller, _ = told
    message = teller.keyframe(pose_at(0.9))
    known = [p for p in message.points.tolist() if p in world.points]
    first, second = known[0], known[7]
    for gone, kept in ((first, second), (known[21], known[14])):  # the first goes, the last goes
        world.fuse(gone, kept)
    observed = world.absorb(message).observed
    points = message.points.tolist()
    assert observed[second] == points.index(second)
    assert observed[known[14]] == points.index(known[14])
    check(world)


@pytest.mark.parametrize("has_heard", [False, True])
def test_what_was_under_way_while_a_loop_gave_its_part_another_unit_is_in_that_unit(has_heard):
    """Until the tracker has heard of it and joined the part too."""
    teller, world, factor = Teller(3000), GlobalMap(), 2.0
    poses = [pose_at(0.25 * i, 0.0, 0.0, 0.0, -0.1 * i) for i in range(4)]
    messages = [replace(teller.keyframe(pose), part=5) for pose in poses]
    for message in messages[:3]:
        world.absorb(message)
    motion = pose_at(7.0, 0.0, 0.0, 0.0, 0.3)

    def moved(pose):
        there = pose.copy()
        there[:3, 3] *= factor
        return motion @ there

    similarities = {
        k: Similarity(moved(keyframe.world_from_camera), factor, factor)
        for k, keyframe in world.keyframes.items()
    }
    apply(world, similarities)
    world.part_grew(5, factor)
    message = messages[3]
    if has_heard:  # what it sends of its own accord is in the new unit
        joined, units = np.array([[5, HOME]]), np.zeros((1, 2))
        message, factor = replace(message, joined=joined, joined_units=units, part=HOME), 1.0
    keyframe = world.absorb(message)
    assert len(message.new_points) > 3
    if not has_heard:
        assert keyframe.world_from_camera == pytest.approx(moved(message.world_from_camera), abs=1e-6)
    assert keyframe.grown == factor
    assert world.keyframes[messages[0].id].grown == 2.0
    for point, told in zip(message.new_points.tolist(), message.new_positions, strict=True):
        depth = transform(inverse(message.world_from_camera), told[None])[0, 2]
        here = transform(inverse(keyframe.world_from_camera), world.points[point].position[None])[0, 2]
        assert here == pytest.approx(factor * depth, rel=1e-6)


def test_a_culled_keyframe_that_was_never_told_is_no_matter(told):
    """The tracker made it while the backend was down."""
    world, _, messages = told
    world.absorb(quiet(messages[-1], culled_keyframes=[77, 2]))
    assert set(world.keyframes) == {0, 1, 3, 4, 5}
    assert 77 not in poses_of(world)
    check(world)


def test_the_only_keyframe_stays():
    """Nothing is left that could carry it."""
    teller, world = Teller(), GlobalMap()
    message = teller.keyframe(POSES[0])
    world.absorb(replace(message, culled_keyframes=np.array([message.id])))
    assert list(world.keyframes) == [message.id]
    check(world)
