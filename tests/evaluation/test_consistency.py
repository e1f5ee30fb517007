"""Errors drawn from the covariances that are published with them have a NEES of 1, and others have not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prism_edge.config import FramesConfig
from prism_edge.evaluation.consistency import NO_NEES, pose_nees, relative_nees, scale_errors
from prism_edge.evaluation.recording import Published, Recording
from prism_edge.evaluation.trajectory import NS, Trajectory
from prism_edge.geometry.mount import base_from_camera
from prism_edge.geometry.poses import from_rt, inverse, scaled, se3_exp, so3_exp, swung
from prism_edge.messages import OK, Tracked

MOUNT = base_from_camera(
    FramesConfig(base_from_camera_xyz=(0.3, -0.1, 0.5), base_from_camera_xyzw=(-0.4, 0.5, -0.55, 0.53))
)
RATE, FRAMES = 5, 60
OWN = np.diag([4.0, 1.0, 2.0, 1.0, 3.0, 2.0]) * 1e-6
OWN[0, 4] = OWN[4, 0] = 1.5e-6


def world_from_camera(time_s: float) -> np.ndarray:
    """A walk of 0.8 m/s past bends, far from where it began."""
    turn = Rotation.from_euler("yxz", [0.3 * time_s, 0.1 * np.sin(time_s), 0.05]).as_matrix()
    return from_rt(turn, np.array([0.8 * time_s, 0.2 * np.sin(time_s), 0.3 * time_s]))


def drawn(
    rng: np.random.Generator, own: float = 1.0, scale: float = 0.0, stated: tuple[np.ndarray, ...] = (OWN,)
) -> tuple[Recording, Trajectory]:
    """A run whose errors are ``own`` times those ``stated`` of its frames in turn, and a scale error."""
    begin = world_from_camera(0.0)
    metres = float(np.exp(rng.normal(0.0, scale)))
    recording, rows = Recording(), []
    for i in range(FRAMES):
        stamp, true = i * NS // RATE, world_from_camera(i / RATE)
        rows.append((stamp, true))
        map_from_base = MOUNT @ scaled(inverse(begin) @ true, metres) @ inverse(MOUNT)
        of_frame = stated[i % len(stated)]
        noise = rng.multivariate_normal(np.zeros(6), own * of_frame)
        estimate = map_from_base @ se3_exp(noise)
        turn = np.kron(np.eye(2), estimate[:3, :3])
        covariance = turn @ of_frame @ turn.T
        start = (estimate @ MOUNT)[:3, 3] - MOUNT[:3, 3]
        covariance[:3, :3] += scale**2 * np.outer(start, start)
        recording.poses.append(Published(stamp, stamp, estimate @ MOUNT, covariance))
        recording.frames.append(Tracked(i, stamp, stamp, OK, True, -1, 0, np.eye(4), 0, False, scale))
    return recording, Trajectory.of(rows)


def averages(runs: int = 25, **errors: float) -> np.ndarray:
    rng = np.random.default_rng(5)
    found = [relative_nees(*drawn(rng, **errors), MOUNT) for _ in range(runs)]
    assert all(nees.pairs == FRAMES - RATE for nees in found)
    return np.mean([[nees.all, nees.translation, nees.rotation] for nees in found], axis=0)


def begun(recording: Recording, at: int = 0) -> Recording:
    """The same, its map begun by a frame before the first pose that refers to it."""
    stamp = at * NS // RATE
    frames = [replace(f, keyframe=0) if f.index == at else f for f in recording.frames]
    return replace(recording, frames=frames, poses=[p for p in recording.poses if p.stamp_ns > stamp])


@pytest.mark.parametrize(("own", "scale"), [(1.0, 0.0), (1.0, 0.05), (4.0, 0.0)])
def test_a_pose_by_itself_is_judged_by_all_that_is_published_with_it(own: float, scale: float):
    rng, found = np.random.default_rng(7), []
    for _ in range(25):
        recording, truth = drawn(rng, own, scale)
        nees = pose_nees(begun(recording), truth, MOUNT)
        assert nees.pairs == FRAMES - RATE
        found.append([nees.all, nees.translation, nees.rotation])
    assert np.mean(found, axis=0) == pytest.approx([own] * 3, rel=0.3)  # one scale a run


def test_an_error_that_stays_shows_in_poses_and_in_no_motion():
    recording, truth = drawn(np.random.default_rng(0))
    aside = se3_exp(np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0]))
    moved = [replace(p, map_from_camera=aside @ p.map_from_camera) for p in recording.poses]
    recording = replace(begun(recording), poses=moved)
    assert pose_nees(recording, truth, MOUNT).translation == pytest.approx(0.02**2 / 3 / 2e-6, rel=0.3)
    assert relative_nees(recording, truth, MOUNT).all == pytest.approx(1.0, abs=0.3)


def test_a_pose_is_judged_from_where_its_map_began_or_not_at_all():
    recording, truth = drawn(np.random.default_rng(0))
    assert pose_nees(recording, truth, MOUNT) == NO_NEES, "nobody says which frame began the map"
    assert pose_nees(begun(recording), truth.at(truth.stamps > 0), MOUNT) == NO_NEES
    assert pose_nees(Recording(), truth, MOUNT) == NO_NEES
    assert pose_nees(begun(recording), truth.at(truth.stamps < NS), MOUNT) == NO_NEES
    assert pose_nees(begun(recording, at=1), truth, MOUNT).translation > 100.0, "it began elsewhere"


@pytest.mark.parametrize("scale", [0.0, 0.05])
def test_errors_as_large_as_published_have_a_nees_of_one(scale):
    assert averages(scale=scale) == pytest.approx([1.0, 1.0, 1.0], abs=0.3)  # one scale a run


def test_errors_four_times_as_large_in_variance_have_four():
    assert averages(own=4.0) == pytest.approx([4.0, 4.0, 4.0], rel=0.15)


def test_a_turn_that_is_off_where_a_second_begins_sets_its_end_aside_and_not_the_reverse():
    sure, unsure = np.diag([1e-8] * 6), np.diag([1e-8] * 3 + [1e-4] * 3)
    assert averages(stated=(unsure, sure)) == pytest.approx([1.0, 1.0, 1.0], abs=0.2)


@pytest.mark.parametrize(
    ("field", "moved", "turned", "falls"),
    [
        ("drift_m", 1.0, 1.0, False),
        ("walk_m", 0.5, 1.0, False),
        ("drift_rad", 1.0, 1.0, False),
        ("walk_rad", 0.84, 0.5, False),  # and swings the base: below
        ("walk_m", 0.5, 1.0, True),  # of a tracker that began anew
    ],
)
def test_of_drift_only_what_odom_s_walk_adds_in_the_second_counts(field, moved, turned, falls):
    """Nothing drifts here; in a second the walk is said to grow by as much as two frames' own errors."""
    rng, runs = np.random.default_rng(0), []
    for _ in range(20):
        recording, truth = drawn(rng)
        for i, (pose, frame) in enumerate(zip(recording.poses, recording.frames, strict=True)):
            stated = np.sqrt(2.0 * OWN[2, 2] * (FRAMES - i if falls else i) / RATE)
            added = stated**2 * np.diag([field == "drift_m"] * 3 + [field == "drift_rad"] * 3)
            base = pose.map_from_camera @ inverse(MOUNT)
            added = swung(added, base[:3, 3] - pose.map_from_camera[:3, 3])  # the camera drifts
            recording.poses[i] = Published(pose.stamp_ns, 0, pose.map_from_camera, pose.covariance + added)
            recording.frames[i] = Tracked(**{**vars(frame), field: stated})
        runs.append(relative_nees(recording, truth, MOUNT))
    assert np.mean([nees.rotation for nees in runs]) == pytest.approx(turned, rel=0.2)
    assert np.mean([nees.translation for nees in runs]) == pytest.approx(moved, rel=0.2)


def test_what_turns_a_camera_on_its_way_swings_a_base_that_is_far_from_it(monkeypatch):
    far, per_frame = from_rt(MOUNT[:3, :3], 5.0 * MOUNT[:3, 3]), 2e-3
    monkeypatch.setitem(globals(), "MOUNT", far)
    rng, found = np.random.default_rng(4), []
    for _ in range(25):
        recording, truth = drawn(rng)
        before = moved = recording.poses[0].map_from_camera
        for i, (pose, frame) in enumerate(zip(recording.poses, recording.frames, strict=True)):
            turn = from_rt(so3_exp(rng.normal(0.0, per_frame, 3)), np.zeros(3))
            before, moved = pose.map_from_camera, moved @ inverse(before) @ pose.map_from_camera @ turn
            stated = per_frame * np.sqrt(i + 1)
            arm = (moved @ inverse(far))[:3, 3] - moved[:3, 3]
            added = swung(np.diag([0.0] * 3 + [stated**2] * 3), arm)
            recording.poses[i] = Published(pose.stamp_ns, 0, moved, pose.covariance + added)
            recording.frames[i] = Tracked(**{**vars(frame), "walk_rad": stated, "drift_rad": stated})
        found.append(relative_nees(recording, truth, far))
    assert np.mean([nees.rotation for nees in found]) == pytest.approx(1.0, abs=0.2)
    assert np.mean([nees.translation for nees in found]) == pytest.approx(1.0, abs=0.2)


def test_drift_that_a_loop_takes_out_may_set_two_poses_apart():
    """Half way a drift of 5 cm, told in the covariance, is gone: where it was told rightly, the NEES is 1."""
    rng, half, told = np.random.default_rng(2), FRAMES // 2, 0.05
    runs: dict[float, list[float]] = {1.0: [], 3.0: []}
    for times, found in runs.items():
        for _ in range(60):
            recording, truth = drawn(rng)
            away = rng.normal(0.0, times * told, 3)
            for i in range(half):
                pose, frame = recording.poses[i], recording.frames[i]
                moved = pose.map_from_camera.copy()
                moved[:3, 3] += away
                added = np.diag([told**2] * 3 + [0.0] * 3)
                recording.poses[i] = Published(pose.stamp_ns, 0, moved, pose.covariance + added)
                recording.frames[i] = Tracked(**{**vars(frame), "drift_m": told})
            found.append(relative_nees(recording, truth, MOUNT).translation or 0.0)
    assert np.mean(runs[1.0]) == pytest.approx(1.0, abs=0.1)
    assert np.mean(runs[3.0]) > 1.5  # RATE pairs of 55, nine times too large


def test_a_published_scale_that_is_too_sure_shows():
    rng = np.random.default_rng(1)
    recording, truth = drawn(rng)
    poses = []
    for pose in recording.poses:
        poses.append(Published(pose.stamp_ns, 0, scaled(pose.map_from_camera, 1.2), pose.covariance))
    nees = relative_nees(Recording(poses, recording.frames), truth, MOUNT)
    assert nees.translation > 100.0  # 17 cm a second, of millimetres


def test_without_pairs_there_is_none():
    recording, truth = drawn(np.random.default_rng(0))
    nobody = Trajectory.of([])
    assert relative_nees(recording, nobody, MOUNT).all is None
    assert relative_nees(Recording(), truth, MOUNT).all is None
    assert relative_nees(recording, truth, MOUNT, delta_s=100.0).pairs == 0
    bare = [Published(p.stamp_ns, 0, p.map_from_camera) for p in recording.poses]
    assert relative_nees(Recording(bare, recording.frames), truth, MOUNT).all is None
    broken = [Published(p.stamp_ns, 0, p.map_from_camera, np.full((6, 6), np.nan)) for p in recording.poses]
    assert relative_nees(Recording(broken, recording.frames), truth, MOUNT).all is None


def test_truth_that_is_too_sparse_for_a_second_judges_nothing():
    recording, truth = drawn(np.random.default_rng(0))
    nees = relative_nees(recording, truth.at(np.arange(0, FRAMES, 11)), MOUNT)  # every 2.2 s
    assert (nees.pairs, nees.all) == (0, None)


def test_a_pose_with_several_true_ones_near_it_is_judged_once():
    recording, truth = drawn(np.random.default_rng(0))
    part = truth.at(np.arange(FRAMES // 4))  # RATE is 5 Hz; three true poses within 10 ms of each
    rows = zip(part.stamps, part.poses, strict=True)
    dense = [(int(stamp) + ms * 1_000_000, pose) for stamp, pose in rows for ms in (-4, 0, 4)]
    assert relative_nees(recording, Trajectory.of(dense), MOUNT) == relative_nees(recording, part, MOUNT)


def test_scale_errors_in_sigmas():
    error, to_bias = scale_errors(float(np.exp(-0.25)), 0.125, 0.1)
    assert error == pytest.approx(2.0)
    assert to_bias == pytest.approx(1.25)
    assert scale_errors(None, 0.1, 0.05)[0] is None
    assert scale_errors(1.1, None, None) == (None, None)
    assert scale_errors(1.1, 0.0, 0.1) == (None, None)
    assert scale_errors(1.1, 0.1, None)[1] is None
    assert scale_errors(1.1, 0.1, 0.0)[1] is None


def test_a_turn_is_judged_about_the_axes_of_map() -> None:
    """All but one of the base's turns are sure, and it looks another way than at the beginning."""
    stated = np.diag([1e-6, 1e-6, 1e-6, 1e-4, 1e-8, 1e-8])
    rng, found = np.random.default_rng(7), []
    for _ in range(10):
        recording, truth = drawn(rng, stated=(stated,))
        found.append(pose_nees(begun(recording), truth, MOUNT).rotation)
    assert np.mean(found) == pytest.approx(1.0, rel=0.2)
