"""The backend composed, fed with a cloud's keyframes and with a real tracker's."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend.global_map import UNKNOWN
from prism_edge.backend.loop_closing import MapChanges
from prism_edge.backend.mapper import Mapper
from prism_edge.backend.window import Solution, choose_window
from prism_edge.bus import codec
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import inverse, se3_exp, transform
from prism_edge.messages import HOME, Gate, MapUpdate
from tests.backend.world import Teller, check, depth_at_keypoints, poses_of, quiet, step, told_depth
from tests.tracking.cloud import pose_at

CONFIG = BackendConfig(observations=300)
WIDE = np.array([0.25, -0.375, 0.25, -0.375])


def plane(distance: float = 3.0) -> np.ndarray:
    return np.full((120, 160), distance, np.float32)


def test_a_new_epoch_begins_a_new_map():
    mapper = Mapper(CONFIG)
    old, new = Teller(), Teller(epoch=1)
    for i in range(3):
        mapper.absorb(old.keyframe(pose_at(0.2 * i)))
    mapper.absorb(new.keyframe(np.eye(4)))
    assert mapper.epoch == 1
    assert list(mapper.world.keyframes) == [0]
    check(mapper.world)


@pytest.mark.parametrize("firm", [True, False])
def test_a_keyframe_s_depth_comes_in_map_units_by_its_own_scale(firm):
    """Triangulated points say 3 m are 2 units; without them the filter's scale holds."""
    mapper = Mapper(CONFIG)
    message = Teller().keyframe(np.eye(4))
    parallax = message.parallax_deg if firm else np.zeros_like(message.parallax_deg)
    message = replace(message, depths=np.full(len(message.points), 2.0, np.float32), parallax_deg=parallax)
    mapper.absorb(message)
    depth = plane(3.0)
    depth[:, :20] = 6.0  # a few points disagree
    mapper.add_depth(message, told_depth(depth, WIDE, math.nan, ""), np.log(1.2))
    depths = mapper.world.keyframes[0].depths
    x = message.pixels[:, 0]
    units_per_metre = 2.0 / 3.0 if firm else 1.0 / 1.2
    inside = np.all((message.pixels > 8) & (message.pixels < (630, 470)), axis=1)
    assert depths[inside & (x > 100)] == pytest.approx(3.0 * units_per_metre, rel=1e-5)
    assert depths[inside & (x < 70)] == pytest.approx(6.0 * units_per_metre, rel=1e-5)


def test_invalid_pixels_have_no_depth():
    mapper = Mapper(CONFIG)
    message = Teller().keyframe(np.eye(4))
    message = replace(message, depths=np.full(len(message.points), 3.0, np.float32))
    mapper.absorb(message)
    depth = plane()
    depth[:, :80] = np.nan
    mapper.add_depth(message, told_depth(depth, WIDE, math.nan, ""), 0.0)
    depths = mapper.world.keyframes[0].depths
    x = message.pixels[:, 0]
    assert not depths[x < 300].any()
    assert (depths[(x > 340) & (x < 630)] > 0).all()


def test_a_network_that_does_not_tell_near_from_far_is_left_out():
    """The points lie between 2 and 7 m, the network says 3 for all: that would flatten the scene."""
    mapper = Mapper(CONFIG)
    message = Teller().keyframe(np.eye(4))
    mapper.absorb(message)
    mapper.add_depth(message, told_depth(plane(3.0), WIDE, math.nan, ""), 0.0)
    assert mapper.world.keyframes[0].depths is None
    kept = mapper.world.keyframes[0].unfitting
    assert kept is not None
    assert set(kept.tolist()) - {0.0} == {3.0}, "it is kept, as the map may be what is wrong"
    mapper.add_depth(message, told_depth(plane(3.0), WIDE, math.nan, "one"), 0.0)
    told = told_depth(plane(3.0), WIDE, math.nan, "another", 99)
    mapper.add_late_depth(told, 0.0)  # of a keyframe that is gone
    assert mapper.world.keyframes[0].unfitting is not None
    mapper.absorb(replace(quiet(message), id=1))
    mapper.add_late_depth(told_depth(plane(3.0), WIDE, math.nan, "another", 1), 0.0)
    assert mapper.world.keyframes[0].unfitting is None, "other metres than the later network's"


def test_depth_of_a_keyframe_that_is_gone_is_no_matter():
    mapper = Mapper(CONFIG)
    teller = Teller()
    mapper.absorb(teller.keyframe(np.eye(4)))
    mapper.add_depth(teller.keyframe(pose_at(0.2)), told_depth(plane(), WIDE, math.nan, ""), 0.0)
    assert list(mapper.world.keyframes) == [0]


@pytest.fixture
def solved():
    mapper, teller = Mapper(CONFIG, first_id=500), Teller(noise_px=0.3)
    for i in range(5):
        message = teller.keyframe(pose_at(0.2 * i, 0.0, 0.0, 0.0, -0.03 * i))
        mapper.absorb(message)
    rng = np.random.default_rng(0)
    for k in (1, 2, 3, 4):
        keyframe = mapper.world.keyframes[k]
        keyframe.world_from_camera = keyframe.world_from_camera @ se3_exp(rng.normal(0, 0.01, 6))
        wrong = rng.permutation(list(keyframe.observed.values()))[:3]
        keyframe.pixels[wrong] += 80.0 * rng.choice((-1, 1), (3, 2))
    depth_at_keypoints(mapper.world, teller.cloud, teller.poses)
    update = mapper.optimise(4, 0.0)
    return mapper, teller, update


def test_an_update_says_what_the_map_now_is(solved):
    mapper, teller, update = solved
    packed = codec.unpack(codec.pack(update), MapUpdate)
    assert (packed.epoch, packed.sequence, packed.based_on) == (0, 501, 4)
    for k, pose in zip(packed.keyframes.tolist(), packed.poses, strict=True):
        assert np.array_equal(mapper.world.keyframes[k].world_from_camera, pose)
        assert np.linalg.norm((inverse(teller.poses[k]) @ pose)[:3, 3]) < 0.05
    for p, place in zip(packed.points.tolist(), packed.positions, strict=True):
        assert np.array_equal(mapper.world.points[p].position, place)
    assert len(packed.parallax_deg) == len(packed.points) > 100
    assert packed.solve_ms > 0


def test_wrong_observations_leave_the_map_and_are_told(solved):
    mapper, _, update = solved
    check(mapper.world)
    dropped = list(zip(update.dropped_keyframes.tolist(), update.dropped_points.tolist(), strict=True))
    assert len(dropped) >= 10
    for k, p in dropped:
        assert p not in mapper.world.keyframes[k].observed
    assert not set(update.points.tolist()) - set(mapper.world.points)


def test_an_update_names_no_point_that_its_wrong_observations_have_ended():
    """Seen by two keyframes that can't both be right, it is gone once they are dropped."""
    mapper, teller = Mapper(CONFIG, use_depth=False), Teller(noise_px=0.3)
    for i in range(5):
        mapper.absorb(teller.keyframe(pose_at(0.2 * i)))
    lost = next(p for p, point in mapper.world.points.items() if len(point.keyframes) == 2)
    keyframe = mapper.world.keyframes[min(mapper.world.points[lost].keyframes)]
    keyframe.pixels[keyframe.observed[lost], 1] += 80.0  # across the way, where no depth explains it
    update = mapper.optimise(4, 0.0)
    assert lost in update.dropped_points
    assert lost not in mapper.world.points
    assert lost not in update.points


def test_points_that_a_window_leaves_out_go_with_the_keyframe_that_made_them():
    """A window takes some points of each keyframe; the others must not stay where the keyframe was."""
    mapper, teller = Mapper(BackendConfig(observations=40)), Teller(600)
    poses = [pose_at(0.2 * i, 0.0, 0.02 * i, 0.0, yaw) for i, yaw in enumerate((0.0, 0.0, 0.0, -0.3))]
    for pose in poses:
        mapper.absorb(teller.keyframe(pose))
    depth_at_keypoints(mapper.world, teller.cloud, poses)
    for point in mapper.world.points.values():  # most are triangulated from the newer view, and seen before
        point.made_by = max(point.keyframes)
    newest = mapper.world.keyframes[3]
    off = se3_exp(np.array([0.1, 0.05, -0.1, 0.02, 0.03, 0.0]))
    newest.world_from_camera = newest.world_from_camera @ off

    def in_own_view() -> dict[int, np.ndarray]:
        views = {p: mapper.world.keyframes[x.made_by] for p, x in mapper.world.points.items()}
        return {
            p: transform(inverse(view.world_from_camera), mapper.world.points[p].position[None])[0]
            for p, view in views.items()
        }

    before, was = in_own_view(), newest.world_from_camera.copy()
    update = mapper.optimise(3, 0.0)
    left = [p for p in before if p not in set(update.points.tolist()) and p in mapper.world.points]
    of_newest = [p for p in left if mapper.world.points[p].made_by == 3]
    assert np.linalg.norm(newest.world_from_camera[:3, 3] - was[:3, 3]) > 0.05
    assert len(left) > 100
    assert len(of_newest) > 5
    after = in_own_view()
    assert max(np.linalg.norm(after[p] - before[p]) for p in left) < 1e-9


def test_a_point_that_its_maker_has_lost_sight_of_goes_with_it_all_the_same():
    """As in the tracker: nothing else has been said of its place."""
    mapper, teller = Mapper(CONFIG), Teller()
    for i in range(4):
        mapper.absorb(teller.keyframe(pose_at(0.2 * i)))
    point = next(p for p in mapper.world.points.values() if not p.keyframes & {2, 3})
    point.made_by, place = 3, point.position.copy()
    motion, pose = pose_at(0.1, 0.2, -0.1, 0.05, 0.1), mapper.world.keyframes[3].world_from_camera
    mapper.replay(Solution({3: motion @ pose}, {}, {}, [], 0))
    assert point.position == pytest.approx(transform(motion, place[None])[0], abs=1e-9)


def test_points_of_a_loaded_map_go_with_the_oldest_keyframe_that_sees_them():
    """A saved map does not say who made them, and a window leaves most of them out."""
    mapper, teller = Mapper(CONFIG), Teller()
    for i in range(4):
        mapper.absorb(teller.keyframe(pose_at(0.4 * i)))
    world = mapper.world
    for point in world.points.values():
        point.made_by = UNKNOWN
    before = {p: point.position.copy() for p, point in world.points.items()}
    oldest = {p: min(point.keyframes) for p, point in world.points.items()}
    motion = pose_at(0.1, 0.2, -0.1, 0.05, 0.1)
    mapper.replay(Solution({1: motion @ world.keyframes[1].world_from_camera}, {}, {}, [], 0))
    assert {0, 1, 2} <= set(oldest.values())
    for p, place in before.items():
        there = transform(motion, place[None])[0] if oldest[p] == 1 else place
        assert world.points[p].position == pytest.approx(there, abs=1e-9)


def test_sequences_grow_and_an_empty_answer_takes_one(solved):
    mapper, teller, _ = solved
    message = teller.keyframe(pose_at(1.0))
    nothing = codec.unpack(codec.pack(mapper.nothing(message)), MapUpdate)
    assert (nothing.sequence, nothing.based_on, len(nothing.keyframes)) == (502, 5, 0)
    mapper.absorb(message)
    assert mapper.optimise(5, 0.0).sequence == 503


def test_a_single_keyframe_has_nothing_to_solve():
    mapper = Mapper(CONFIG)
    message = Teller().keyframe(np.eye(4))
    assert step(mapper, message, plane(), WIDE) is None
    assert list(poses_of(mapper.world)) == [0]


def test_an_update_carries_each_points_mean_weight():
    """Of the keyframes whose gate knows anything of it, relative to the keyframe's median; else 1."""
    mapper, teller = Mapper(CONFIG, use_depth=False), Teller()
    told: dict[int, list[float]] = {}
    for i in range(3):
        message = teller.keyframe(pose_at(0.2 * i))
        mapper.absorb(message)
        weights = np.full(len(message.pixels), 0.3 * i, np.float32)
        weights[::5] *= 0.25  # a fifth stand out from what is, at 0.3 and 0.6, a doubtful view
        known = np.full(len(message.pixels), 0.1 if i else np.nan, np.float32)
        mapper.add_gate(Gate(i, 0, weights, known))
        for keypoint, p in enumerate(message.points.tolist()):
            if i:
                told.setdefault(p, []).append(0.25 if keypoint % 5 == 0 else 1.0)
    update = mapper.optimise(2, 0.0)
    expected = [np.mean(told[p]) if p in told else 1.0 for p in update.points.tolist()]
    np.testing.assert_allclose(update.weights, expected, rtol=1e-5)
    assert min(expected) < 0.3


def test_what_a_gate_trusts_more_than_most_of_a_doubtful_view_counts_once_all_the_same():
    mapper, message = Mapper(CONFIG), Teller().keyframe(np.eye(4))
    mapper.absorb(message)
    weights = np.full(len(message.pixels), 0.3, np.float32)
    weights[::5] = 0.9
    mapper.add_gate(Gate(0, 0, weights, np.full(len(weights), 0.1, np.float32)))
    assert mapper.world.keyframes[0].weights == pytest.approx(np.ones(len(weights)))


@pytest.mark.parametrize(("sigma", "units"), [(math.nan, 1.0), (0.05, 0.0)])
def test_a_sensor_s_depth_has_no_unit_of_the_image_s_own(sigma, units):
    """Its metres are the map's: it has no vote beside those of a network's images (sizes.py)."""
    mapper, message = Mapper(CONFIG), Teller().keyframe(np.eye(4))
    seeded = replace(message, parallax_deg=np.zeros_like(message.parallax_deg))
    mapper.absorb(seeded)
    mapper.add_depth(seeded, told_depth(plane(), WIDE, sigma, ""), 0.0)
    assert mapper.world.keyframes[0].depth_units == units


def test_an_update_of_everything_tells_of_the_window_s_outliers_too(solved):
    mapper, _, update = solved
    whole = mapper.whole(4, MapChanges(dropped=[(1, 7)]), beside=update)

    def told(message: MapUpdate) -> list[tuple[int, int]]:
        dropped = message.dropped_keyframes.tolist(), message.dropped_points.tolist()
        return list(zip(*dropped, strict=True))

    assert len(update.dropped_points) >= 10
    assert told(whole) == [*told(update), (1, 7)]


def test_what_a_culled_keyframe_looked_like_is_forgotten():
    mapper, teller = Mapper(CONFIG), Teller()
    for i in range(4):
        message = teller.keyframe(pose_at(0.2 * i))
        mapper.absorb(message)
        mapper.loops.add_place(i, np.eye(4, dtype=np.float32)[i])
    mapper.absorb(quiet(message, culled_keyframes=[1, 2]))
    assert [k in mapper.loops.index for k in range(4)] == [True, False, False, True]


def test_what_the_tracker_does_not_have_goes_though_nobody_has_said_so() -> None:
    """A message that was lost may have told of it."""
    teller, mapper = Teller(), Mapper(CONFIG, True)
    told = [teller.keyframe(pose_at(0.1 * i)) for i in range(6)]
    for message in told[:5]:
        mapper.absorb(message)
        mapper.loops.index.add(message.id, np.ones(4, np.float32), "net")
    mapper.absorb(replace(told[5], kept=np.array([0, 2, 3, 5]), culled_keyframes=np.array([4])))
    assert sorted(mapper.world.keyframes) == [0, 2, 3, 5]
    assert 1 not in mapper.loops.index
    assert 2 in mapper.loops.index
    assert sorted(poses_of(mapper.world)) == [0, 1, 2, 3, 4, 5], "frames that they carried have a place"
    check(mapper.world)


def test_a_part_that_is_joined_is_of_the_older_one_from_then_on() -> None:
    teller, mapper = Teller(), Mapper(CONFIG, True)
    told = [teller.keyframe(pose_at(0.1 * i)) for i in range(4)]
    for message, part in zip(told[:3], (HOME, 1, 2), strict=True):
        mapper.absorb(replace(message, part=part))
    mapper.absorb(replace(told[3], part=1, joined=np.array([[2, 1]]), joined_units=np.zeros((1, 2))))
    assert [k.part for k in mapper.world.keyframes.values()] == [HOME, 1, 1, 1]


@pytest.mark.parametrize("measured", [{0, 1, 2, 3}, {1, 2, 3}, set()], ids=str)
def test_a_depth_camera_says_how_large_the_map_is_and_a_network_does_not(measured):
    """The map is a tenth too large for its depths: a sensor's metres set that right, a network's waver."""
    mapper, teller = Mapper(CONFIG), Teller()
    poses = [pose_at(0.2 * i, 0.03 * (i % 3)) for i in range(4)]
    for pose in poses:
        mapper.absorb(teller.keyframe(pose))
    world = mapper.world
    depth_at_keypoints(world, teller.cloud, poses)
    for k, keyframe in world.keyframes.items():
        keyframe.depth_sigma, keyframe.depth_units = (0.02, 0.0) if k in measured else (0.0, 1.0)
        keyframe.world_from_camera[:3, 3] *= 1.1
    for point in world.points.values():
        point.position = 1.1 * point.position
    mapper.optimise(3, 0.0)
    began, ended = (world.keyframes[k].world_from_camera[:3, 3] for k in (0, 3))
    way = np.linalg.norm(ended - began)
    true = np.linalg.norm(poses[3][:3, 3])
    assert way / true == pytest.approx(1.0 if measured else 1.1, abs=0.01)


def test_a_window_that_several_poses_hold_has_its_size_from_them_and_not_from_what_it_was():
    """Only where one pose holds it is there nothing else to keep the unit by."""
    config = replace(CONFIG, window=4, fixed=3)
    mapper, teller = Mapper(config, use_depth=False), Teller(noise_px=0.3)
    poses = [pose_at(0.15 * i) for i in range(9)]
    for pose in poses:
        mapper.absorb(teller.keyframe(pose))
    world = mapper.world
    free = choose_window(world, 8, config).free
    for k in free:
        world.keyframes[k].world_from_camera[:3, 3] *= 1.1
    for point in world.points.values():
        point.position = 1.1 * point.position
    mapper.optimise(8, 0.0)
    for k in free:
        off = inverse(poses[k]) @ world.keyframes[k].world_from_camera
        assert np.linalg.norm(off[:3, 3]) < 0.3 * np.linalg.norm(0.1 * poses[k][:3, 3])
