"""The map's frame stays where most keyframes say: rigid motions are undone, corrections aren't."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.backend import pose_graph
from prism_edge.backend.frame import (
    ALIKE,
    LEAST,
    keep_frame,
    majority,
    take_references,
)
from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.mapper import Mapper
from prism_edge.backend.pose_graph import Similarity
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import inverse, se3_exp, se3_log, transform
from tests.backend.world import Teller, check
from tests.tracking.cloud import pose_at

POSES = [pose_at(0.25 * i, 0.05 * i, 0.0, 0.0, -0.04 * i) for i in range(9)]
MOTION = pose_at(0.4, -0.3, 0.2, 0.1, -0.2, 0.15)


def mapped(poses: list[np.ndarray] = POSES) -> GlobalMap:
    world, teller = GlobalMap(), Teller()
    for pose in poses:
        world.absorb(teller.keyframe(pose))
    return world


def poses_of(world: GlobalMap) -> dict[int, np.ndarray]:
    return {k: keyframe.world_from_camera for k, keyframe in world.keyframes.items()}


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-0.8, 0.8), min_size=6, max_size=6))
def test_a_rigid_motion_is_undone(twist: list[float]) -> None:
    world = mapped(POSES[:4])
    before, places = poses_of(world), {p: point.position for p, point in world.points.items()}
    world.move(se3_exp(np.array(twist)), set(world.keyframes))
    keep_frame(world)
    for k, pose in before.items():
        assert world.keyframes[k].world_from_camera == pytest.approx(pose, abs=LEAST)
    for p, place in places.items():
        assert world.points[p].position == pytest.approx(place, abs=5 * LEAST)  # points are farther away
    check(world)


@pytest.mark.parametrize("few", [{8}, {1, 4, 7}])
def test_a_few_that_moved_move_nobody_else(few: set[int]) -> None:
    world = mapped()
    before = poses_of(world)
    for k in few:
        world.keyframes[k].world_from_camera = MOTION @ before[k]
    keep_frame(world)
    for k, pose in before.items():
        true = MOTION @ pose if k in few else pose
        off = se3_log(inverse(true) @ world.keyframes[k].world_from_camera)
        assert np.abs(off).max() < ALIKE


def test_corrections_that_come_to_most_in_turn_move_nobody_else() -> None:
    """Each is of a few; from then on they belong where it has put them."""
    world = mapped()
    before = poses_of(world)
    for few in ((0, 1, 2), (3, 4, 5)):
        for k in few:
            world.keyframes[k].world_from_camera = MOTION @ world.keyframes[k].world_from_camera
        keep_frame(world)
    for k, pose in before.items():
        true = MOTION @ pose if k < 6 else pose
        off = se3_log(inverse(true) @ world.keyframes[k].world_from_camera)
        assert np.abs(off).max() < 2 * ALIKE


def test_one_that_held_while_all_others_turned_gives_way() -> None:
    """A first keyframe that is held makes the others bear its errors."""
    world = mapped()
    before = poses_of(world)
    world.move(MOTION, set(world.keyframes))
    world.keyframes[0].world_from_camera = before[0]
    assert keep_frame(world)
    for k in range(1, 9):
        assert world.keyframes[k].world_from_camera == pytest.approx(before[k], abs=ALIKE)
    assert np.abs(world.keyframes[0].world_from_camera - before[0]).max() > 0.2


def test_its_shape_is_not_touched() -> None:
    world, rng = mapped(), np.random.default_rng(0)
    before = poses_of(world)
    for k, pose in before.items():
        world.keyframes[k].world_from_camera = MOTION @ pose @ se3_exp(0.05 * rng.normal(size=6))
    bent = poses_of(world)
    assert keep_frame(world)
    now = poses_of(world)
    for k in range(1, 9):
        assert inverse(now[0]) @ now[k] == pytest.approx(inverse(bent[0]) @ bent[k], abs=1e-9)


def test_too_little_to_matter_is_left() -> None:
    world = mapped()
    world.move(pose_at(0.3 * LEAST, 0.0, 0.0, 0.0, 0.0), set(world.keyframes))
    now = poses_of(world)
    assert not keep_frame(world)
    assert all(world.keyframes[k].world_from_camera is pose for k, pose in now.items())


def test_what_is_too_little_each_time_does_not_add_up() -> None:
    """Adjustment after adjustment, to one side: a map of a room that is seen for days stays where it is."""
    world = mapped()
    before = poses_of(world)
    for _ in range(100):
        world.move(pose_at(0.6 * LEAST, 0.0, 0.0, 0.0, 0.0), set(world.keyframes))
        keep_frame(world)
    for k, pose in poses_of(world).items():
        assert pose == pytest.approx(before[k], abs=2 * LEAST)


def test_what_stands_in_for_others_moves_nobody() -> None:
    """A robot stays: a keyframe now and then, each corrected by the same after it was placed."""
    world, teller = GlobalMap(), Teller()
    for pose in POSES:
        world.absorb(teller.keyframe(pose))
    before = poses_of(world)
    for _ in range(100):
        made = world.absorb(replace(teller.keyframe(POSES[4]), stands_in=True))
        made.world_from_camera = pose_at(3.0 * LEAST, 0.0, 0.0, 0.0, 0.0) @ made.world_from_camera
        assert not keep_frame(world)
    for k, pose in before.items():
        assert world.keyframes[k].world_from_camera is pose


def test_a_part_of_nothing_but_stand_ins_has_a_say() -> None:
    world, teller = GlobalMap(), Teller()
    for pose in POSES[:4]:
        world.absorb(replace(teller.keyframe(pose), stands_in=True))
    before = poses_of(world)
    world.move(MOTION, set(world.keyframes))
    assert keep_frame(world)
    for k, pose in before.items():
        assert world.keyframes[k].world_from_camera == pytest.approx(pose, abs=LEAST)


def test_who_has_moved_for_good_is_held_to_where_it_is() -> None:
    """A correction that a loop brought is not undone by the adjustments after it, and holds as before."""
    world = mapped()
    for k in (6, 7, 8):
        world.keyframes[k].world_from_camera = MOTION @ world.keyframes[k].world_from_camera
    take_references(world)
    corrected = poses_of(world)
    assert not keep_frame(world)
    world.move(MOTION, set(world.keyframes))
    assert keep_frame(world)
    for k, pose in poses_of(world).items():
        assert pose == pytest.approx(corrected[k], abs=LEAST)


def test_what_a_loop_has_moved_stays_though_it_is_most_of_the_map() -> None:
    world = mapped()
    before = poses_of(world)
    joined = {k: Similarity(MOTION @ before[k], 1.0) for k in range(2, 9)}
    pose_graph.apply(world, joined)
    keep_frame(world)
    for k, pose in poses_of(world).items():
        true = joined[k].world_from_camera if k in joined else before[k]
        assert pose == pytest.approx(true, abs=LEAST)


def test_a_single_keyframe_has_nothing_to_be_compared_with() -> None:
    world = mapped(POSES[:1])
    world.move(MOTION, set(world.keyframes))
    assert not keep_frame(world)
    assert not keep_frame(GlobalMap())


def test_two_keyframes_are_enough_to_tell_a_motion_of_the_frame() -> None:
    world = mapped(POSES[:2])
    before = poses_of(world)
    world.move(MOTION, set(world.keyframes))
    assert keep_frame(world)
    for k, pose in before.items():
        assert world.keyframes[k].world_from_camera == pytest.approx(pose, abs=LEAST)


def test_cameras_that_turned_on_the_spot_take_the_frame_nowhere() -> None:
    """What is seen has no side: a turn back about where the cameras are leaves their middle where it is."""
    world = mapped()
    middle = np.mean([pose[:3, 3] for pose in poses_of(world).values()], axis=0)
    for keyframe in world.keyframes.values():
        keyframe.world_from_camera = keyframe.world_from_camera @ pose_at(0, 0, 0, 0.005, 0.004, -0.003)
    assert keep_frame(world)
    now = np.mean([pose[:3, 3] for pose in poses_of(world).values()], axis=0)
    assert now == pytest.approx(middle, abs=1e-9)


def test_a_part_of_its_own_moves_nobody_else() -> None:
    """Where it is beside the others is not known; its corrections, and its majority, are its own."""
    home, apart = Teller(), Teller(seed=1, first=20)
    world = GlobalMap()
    for pose in POSES[:4]:
        world.absorb(home.keyframe(pose))
    for pose in POSES:
        message = apart.keyframe(pose)
        renamed = {"points": message.points + 10_000, "new_points": message.new_points + 10_000}
        world.absorb(replace(message, **renamed))
    before = poses_of(world)
    for k in range(21, 29):
        world.keyframes[k].world_from_camera = MOTION @ before[k]
    assert keep_frame(world)
    assert all(world.keyframes[k].world_from_camera is before[k] for k in range(4))
    for k in range(21, 29):
        assert world.keyframes[k].world_from_camera == pytest.approx(before[k], abs=ALIKE)
    check(world)


def test_points_that_all_coincide_have_no_frame() -> None:
    assert majority(np.zeros((5, 3)), np.ones((5, 3))) is None


def test_a_window_that_moves_the_frame_tells_of_all_keyframes() -> None:
    """A tracker that hears of it has the same map, though only the window's points are named."""
    mapper, teller = Mapper(BackendConfig(window=4)), Teller(noise_px=0.3)
    for pose in POSES:
        mapper.absorb(teller.keyframe(pose))
    for k in range(3, 9):  # most of what the window holds is off, and will come back
        pose = mapper.world.keyframes[k].world_from_camera
        mapper.world.keyframes[k].world_from_camera = pose @ se3_exp(np.full(6, 0.02))
    before = poses_of(mapper.world)
    update = mapper.optimise(8, 0.0)
    assert update is not None
    assert set(update.keyframes.tolist()) == before.keys()
    now = poses_of(mapper.world)
    for k, pose in zip(update.keyframes.tolist(), update.poses, strict=True):
        assert now[k] == pytest.approx(pose, abs=1e-12)
    for p, position in zip(update.points.tolist(), update.positions, strict=True):
        assert mapper.world.points[p].position == pytest.approx(position, abs=1e-12)


def test_moving_a_map_moves_its_points() -> None:
    world = mapped(POSES[:3])
    before = {p: point.position for p, point in world.points.items()}
    world.move(MOTION, set(world.keyframes))
    for p, place in before.items():
        assert world.points[p].position == pytest.approx(transform(MOTION, place[None])[0], abs=1e-12)
    GlobalMap().move(MOTION, set())  # an empty one has nothing to move
