"""Keyframes that the backend never heard of (it was being started again) go along when the map is moved."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.local_copy import local_copy
from prism_edge.backend.mapper import Mapper
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import inverse, rotation_angle, transform
from prism_edge.tracking.map_correction import MIN_COMMON, apply_correction, take_over
from prism_edge.tracking.submaps import Parts
from tests.backend.ring import Ring
from tests.synthetic.messages import map_update
from tests.tracking.cloud import BY_POINTS, Cloud, check, pose_at

DRIFT = np.array([0.012, 0.006, -0.012, 0.002, -0.004, 0.002])
LOST = (30, 31, 32)
MOTION = pose_at(0.3, -0.2, 0.1, 0.02, 0.1, -0.05)
POSES = [pose_at(0.3 * i, 0.0, 0.0, 0.0, -0.04 * i) for i in range(6)]


def test_what_was_lost_goes_along_when_a_loop_is_closed() -> None:
    ring = Ring(drift=DRIFT, stretch=1.004)
    tracker_s, backend_s = (Mapper(BackendConfig(), use_depth=False) for _ in range(2))
    closed = None
    while closed is None:
        keyframe = ring.keyframe()
        tracker_s.absorb(keyframe)
        if keyframe.id in LOST:
            continue
        backend_s.absorb(keyframe)
        backend_s.loops.add_place(keyframe.id, ring.looks_like(keyframe.id))
        closed = backend_s.loops.look(keyframe.id)
    world = local_copy(tracker_s.world)
    before = {k: keyframe.world_from_camera.copy() for k, keyframe in world.keyframes.items()}
    table = world.points
    own = np.flatnonzero(table.alive & np.isin(table.reference, LOST))
    own = own[~np.isin(table.ids[own], list(backend_s.world.points))]
    assert len(own) > 50, "points that the backend has never heard of either"
    places = table.position[own].copy()
    update = backend_s.whole(keyframe.id, backend_s.loops.take_changes(), None, closed)
    assert update.everything
    take_over(world, Parts(), update, None, BY_POINTS)
    after = {k: keyframe.world_from_camera for k, keyframe in world.keyframes.items()}
    assert np.linalg.norm(after[29][:3, 3] - before[29][:3, 3]) > 0.2, "the loop moves their surroundings"
    for k in range(29, 32):  # beyond, the backend has nothing that would hold the ends together
        bent = inverse(inverse(before[k]) @ before[k + 1]) @ inverse(after[k]) @ after[k + 1]
        assert np.linalg.norm(bent[:3, 3]) < 0.05
        assert rotation_angle(bent[:3, :3]) < np.radians(1.0)
    alive = table.alive[own]
    there = transform(inverse(after[30]), table.position[own[alive]])
    off = there - transform(inverse(before[30]), places[alive])
    assert np.median(np.linalg.norm(off, axis=1)) < 0.1
    check(world)


@pytest.mark.parametrize(
    ("everything", "named", "moving"),
    [
        (True, [0, 1, 4, 5], [0, 1, 2, 3, 4, 5]),
        (True, [2, 4, 5], [2, 3, 4, 5]),  # nothing says where those before the first belong
        (False, [0, 1, 4, 5], [0, 1, 4, 5]),  # a window's: what it leaves out it leaves in its place
    ],
)
def test_who_goes_along(everything: bool, named: list[int], moving: list[int]) -> None:
    world, _ = Cloud(400, seed=0).mapped(POSES)
    table, before = world.points, world.points.position.copy()
    known = table.ids[np.isin(table.reference, named)].copy()
    positions = transform(MOTION, table.position[table.rows(known)])
    poses = np.array([MOTION @ POSES[k] for k in named])
    parallax = np.zeros(len(known), np.float32)
    update = map_update(
        5, keyframes=np.array(named), poses=poses, points=known, positions=positions, parallax_deg=parallax,
        everything=everything,
    )  # fmt: skip
    motions = apply_correction(world, update, BY_POINTS, Parts())
    assert motions[5] == pytest.approx(MOTION, abs=1e-9)
    for k, pose in enumerate(POSES):
        there = MOTION @ pose if k in moving else pose
        assert world.keyframes[k].world_from_camera == pytest.approx(there, abs=1e-3)
    along = np.isin(table.reference, moving)
    assert table.position[along] == pytest.approx(transform(MOTION, before[along]), abs=1e-2)
    assert np.array_equal(table.position[~along], before[~along])


def test_one_that_was_misplaced_comes_right_by_what_its_neighbours_made() -> None:
    """No point is named: those of keyframes that the backend has hold it all the same."""
    world, _ = Cloud(600, seed=1).mapped(POSES)
    world.keyframes[2].world_from_camera = POSES[2] @ pose_at(0.02, 0.01, -0.02, 0.005)
    named, none = [0, 1, 3, 4, 5], np.zeros(0, np.int64)
    update = map_update(
        5, keyframes=np.array(named), poses=np.array([POSES[k] for k in named]), points=none,
        positions=np.zeros((0, 3)), parallax_deg=np.zeros(0, np.float32), everything=True,
    )  # fmt: skip
    apply_correction(world, update, BY_POINTS, Parts())
    assert world.keyframes[2].world_from_camera == pytest.approx(POSES[2], abs=1e-3)


def test_one_that_was_lost_is_not_held_back_by_points_of_its_own() -> None:
    """Most of what it sees it made itself, where it was before: that goes along, and has no say."""
    world, _ = Cloud(600, seed=1).mapped(POSES)
    lost, table = world.keyframes[2], world.points
    seen = lost.points[lost.observed()]
    mine = table.rows(seen[MIN_COMMON + 10 :])
    table.reference[mine] = lost.id
    named = [0, 1, 3, 4, 5]
    known = table.ids[np.isin(table.reference, named)].copy()
    before = table.position[mine].copy()
    update = map_update(
        5, keyframes=np.array(named), poses=np.array([MOTION @ POSES[k] for k in named]), points=known,
        positions=transform(MOTION, table.position[table.rows(known)]),
        parallax_deg=np.zeros(len(known), np.float32), everything=True,
    )  # fmt: skip
    apply_correction(world, update, BY_POINTS, Parts())
    assert lost.world_from_camera == pytest.approx(MOTION @ POSES[2], abs=1e-3)
    assert table.position[mine] == pytest.approx(transform(MOTION, before), abs=1e-2)


def test_a_window_s_update_does_not_say_that_it_names_everything() -> None:
    ring, mapper = Ring(seed=3), Mapper(BackendConfig(), use_depth=False)
    for keyframe in ring.keyframes(30):
        mapper.absorb(keyframe)
    update = mapper.optimise(29, 0.0)
    assert update is not None
    assert update.everything == (set(update.keyframes.tolist()) == mapper.world.keyframes.keys())
    assert not update.everything
