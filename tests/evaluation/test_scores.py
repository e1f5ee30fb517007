"""Scores against evo, the KITTI definition written out as a loop, and closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from prism_edge.evaluation import scores
from prism_edge.evaluation.scores import ate, of_own_length, r_rel, rpe, score, segments, t_rel
from prism_edge.evaluation.trajectory import NS, Trajectory, associate, read_tum
from prism_edge.geometry.poses import se3_exp

SEEDS = st.integers(0, 2**32 - 1)


def walk(seed: int, n: int = 120, rate_hz: float = 30.0, step_m: float = 0.02) -> Trajectory:
    """A smooth random walk."""
    rng = np.random.default_rng(seed)
    twists = np.cumsum(rng.normal(size=(n, 6)) * 0.1, axis=0) * step_m
    twists[:, 0] += step_m
    pose, poses = np.eye(4), []
    for twist in twists:
        pose = pose @ se3_exp(twist)
        poses.append(pose)
    return Trajectory((np.arange(n) * NS / rate_hz).astype(np.int64), np.array(poses))


def disturbed(truth: Trajectory, seed: int, metres: float = 0.01, radians: float = 0.01) -> Trajectory:
    """The truth in another frame and unit, with noise."""
    rng = np.random.default_rng(seed)
    frame = se3_exp(rng.normal(size=6))
    noise = rng.normal(size=(len(truth), 6)) * (metres, metres, metres, radians, radians, radians)
    poses = np.array([frame @ p @ se3_exp(n) for p, n in zip(truth.poses, noise, strict=True)])
    poses[:, :3, 3] *= 1.3
    return Trajectory(truth.stamps, poses)


def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(trajectory.poses), timestamps=trajectory.stamps / NS)


def evo_ate(estimate: Trajectory, truth: Trajectory, with_scale: bool) -> float:
    theirs, reference = as_evo(estimate), as_evo(truth)
    theirs.align(reference, correct_scale=with_scale)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, theirs))
    return float(ape.get_statistic(metrics.StatisticsType.rmse))


def evo_rpe(estimate: Trajectory, truth: Trajectory, frames: int, relation: metrics.PoseRelation) -> float:
    error = metrics.RPE(relation, delta=frames, delta_unit=metrics.Unit.frames, all_pairs=True)
    error.process_data((as_evo(truth), as_evo(estimate)))
    return float(error.get_statistic(metrics.StatisticsType.rmse))


@settings(max_examples=6, deadline=None)
@given(SEEDS)
def test_ate_and_rpe_are_evos(seed: int) -> None:
    truth = walk(seed)
    estimate = disturbed(truth, seed)
    scores = score(estimate, truth)
    assert scores.ate_se3_m == pytest.approx(evo_ate(estimate, truth, False), abs=1e-6)
    assert scores.ate_sim3_m == pytest.approx(evo_ate(estimate, truth, True), abs=1e-6)
    relations = metrics.PoseRelation
    expected = evo_rpe(estimate, truth, 30, relations.translation_part)
    assert scores.rpe_trans_m == pytest.approx(expected, abs=1e-6)
    expected = evo_rpe(estimate, truth, 30, relations.rotation_angle_deg)
    assert scores.rpe_rot_deg == pytest.approx(expected, abs=1e-6)


@pytest.mark.realdata
def test_ate_is_evos_on_a_real_recording(shared: Path) -> None:
    truth = read_tum(shared / "data" / "tartanair_hospital" / "groundtruth.txt")
    estimate = disturbed(truth, 7, metres=0.05)
    for with_scale in (False, True):
        ours = ate(estimate.positions, truth.positions, with_scale)
        assert ours == pytest.approx(evo_ate(estimate, truth, with_scale), abs=1e-6)


def test_sparse_truth_scores_only_what_it_covers() -> None:
    truth = walk(3)
    estimate = disturbed(truth, 4)
    sparse = truth.at(np.arange(0, len(truth), 10))
    scores = score(estimate, sparse)
    assert scores.pairs == 12
    mine, his = associate(estimate, sparse)
    assert scores.ate_sim3_m == pytest.approx(evo_ate(mine, his, True), abs=1e-6)


def test_frames_are_judged_once_where_dense_truth_covers_a_part() -> None:
    """A perfect estimate at 20 Hz, truth at 240 Hz of its beginning: no error of 10 ms of motion."""
    exact = walk(6, n=4800, rate_hz=240.0, step_m=0.002)
    frames = exact.at(np.arange(0, 4800, 12))
    scores = score(frames, exact.at(np.arange(298)))
    assert scores.pairs == 25
    assert scores.ate_se3_m == pytest.approx(0.0, abs=1e-9)
    assert scores.rpe_trans_m == pytest.approx(0.0, abs=1e-9)


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.floats(0.2, 5.0))
def test_scale_ratio_carries_the_estimate_to_the_truth(seed: int, factor: float) -> None:
    truth = walk(seed)
    poses = truth.poses.copy()
    poses[:, :3, 3] /= factor
    scores = score(Trajectory(truth.stamps, poses), truth)
    assert scores.scale_ratio == pytest.approx(factor, rel=1e-6)
    assert scores.scale_ratio_halves == [pytest.approx(factor, rel=1e-6)] * 2
    assert scores.ate_sim3_m == pytest.approx(0.0, abs=1e-6)


def test_halves_are_told_apart() -> None:
    truth = walk(5)
    poses = truth.poses.copy()
    half = len(truth) // 2
    poses[:half, :3, 3] *= 0.5
    scores = score(Trajectory(truth.stamps, poses), truth, split_ns=int(truth.stamps[half]))
    assert scores.scale_ratio_halves == [pytest.approx(2.0), pytest.approx(1.0)]


def test_a_constant_velocity_error_gives_its_rpe() -> None:
    n, rate = 91, 30.0
    stamps = (np.arange(n) * NS / rate).astype(np.int64)
    truth = Trajectory(stamps, np.tile(np.eye(4), (n, 1, 1)))
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = 0.2 * np.arange(n) / rate  # 0.2 m/s
    poses[:, :3, :3] = Rotation.from_euler("z", 5.0 * np.arange(n)[:, None] / rate, degrees=True).as_matrix()
    trans, rot = rpe(Trajectory(stamps, poses), truth)
    assert trans == pytest.approx(0.2, abs=1e-6)
    assert rot == pytest.approx(5.0, abs=1e-6)


@pytest.mark.parametrize(
    ("interval_s", "known"), [(1 / 3, True), (1.0, True), (1.4, False), (1.6, False), (2.5, False)]
)
def test_truth_that_is_too_sparse_for_a_second_has_no_rpe(interval_s: float, known: bool) -> None:
    """The pose nearest to a second later must be one that is about a second later, not the pose itself."""
    estimate = walk(2, n=600)
    truth = disturbed(estimate, 3).at(np.arange(0, 600, round(30 * interval_s)))
    scores = score(estimate, truth)
    assert scores.pairs == len(truth)
    assert (scores.rpe_trans_m is not None, scores.rpe_rot_deg is not None) == (known, known)
    assert not known or scores.rpe_trans_m > 0.0


def kitti_loop(estimate: Trajectory, truth: Trajectory, lengths: list[float], step: int) -> float:
    """The benchmark's definition, a segment at a time."""
    distances = [0.0]
    for a, b in zip(truth.positions[:-1], truth.positions[1:], strict=True):
        distances.append(distances[-1] + float(np.linalg.norm(b - a)))
    errors = []
    for first in range(0, len(truth), step):
        for length in lengths:
            last = next((i for i, d in enumerate(distances) if d > distances[first] + length), None)
            if last is not None:
                true_motion = np.linalg.inv(truth.poses[first]) @ truth.poses[last]
                motion = np.linalg.inv(estimate.poses[first]) @ estimate.poses[last]
                errors.append(np.linalg.norm((np.linalg.inv(motion) @ true_motion)[:3, 3]) / length)
    return 100.0 * float(np.mean(errors))


def test_t_rel_is_kittis_on_long_paths() -> None:
    truth = walk(11, n=300, rate_hz=10.0, step_m=1.0)
    estimate = disturbed(truth, 12)
    percent, lengths = t_rel(segments(estimate, truth))
    assert lengths[:2] == [100.0, 200.0]
    assert percent == pytest.approx(kitti_loop(estimate, truth, [100.0 * k for k in range(1, 9)], 10))


def test_a_segment_ends_at_the_first_pose_that_is_farther_than_its_length() -> None:
    """As in the benchmark's own tool: a pose that is just as far is not."""
    poses = np.tile(np.eye(4), (31, 1, 1))
    poses[:, 0, 3] = 10.0 * np.arange(31)
    truth = Trajectory(np.arange(31) * NS, poses)
    still = Trajectory(truth.stamps, np.tile(np.eye(4), (31, 1, 1)))
    found = {length: errors[:, 0, 3].tolist() for length, errors in segments(still, truth)}
    assert found == {100.0: [-110.0] * 2, 200.0: [-210.0]}


def devkit_degrees(estimate: Trajectory, truth: Trajectory, lengths: list[float], step: int) -> float:
    """As KITTI's development kit has it, a segment at a time: deg / 100 m, angles by their quaternions."""
    travelled, errors = [0.0], []
    for a, b in zip(truth.positions[:-1], truth.positions[1:], strict=True):
        travelled.append(travelled[-1] + float(np.linalg.norm(b - a)))
    turns = [Rotation.from_matrix(run.poses[:, :3, :3]) for run in (estimate, truth)]
    for first in range(0, len(truth), step):
        for length in lengths:
            beyond = [i for i in range(first, len(truth)) if travelled[i] > travelled[first] + length]
            if beyond:
                turned, truly = (turn[first].inv() * turn[beyond[0]] for turn in turns)
                errors.append(float((truly.inv() * turned).magnitude()) / length)
    return 100.0 * float(np.degrees(np.mean(errors)))


def test_r_rel_is_kittis_on_long_paths() -> None:
    truth = walk(11, n=300, rate_hz=10.0, step_m=1.0)
    estimate = disturbed(truth, 12, radians=0.05)
    expected = devkit_degrees(estimate, truth, [100.0 * k for k in range(1, 9)], 10)
    assert r_rel(segments(estimate, truth)) == pytest.approx(expected)
    assert score(estimate, truth).r_rel_deg_per_100m == pytest.approx(expected)


def test_r_rel_of_short_paths_uses_fractions() -> None:
    truth = walk(13)
    estimate = disturbed(truth, 14)
    path = float(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1).sum())
    lengths = [path * k / 10 for k in range(1, 9)]
    assert r_rel(segments(estimate, truth)) == pytest.approx(devkit_degrees(estimate, truth, lengths, 1))
    assert of_own_length(score(estimate, truth).t_rel_lengths_m)


def test_a_steady_turn_is_its_r_rel() -> None:
    n = 401
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 2, 3] = np.arange(n)
    stamps = np.arange(n) * NS // 10
    turned = poses.copy()  # on the spot, by 0.02 degrees a metre
    turned[:, :3, :3] = Rotation.from_euler("y", 0.02 * np.arange(n)[:, None], degrees=True).as_matrix()
    truth = Trajectory(stamps, poses)
    assert r_rel(segments(Trajectory(stamps, turned), truth)) == pytest.approx(2.0, rel=0.01)
    assert not of_own_length(t_rel(segments(truth, truth))[1])


def test_t_rel_of_short_paths_uses_fractions() -> None:
    truth = walk(13)
    estimate = disturbed(truth, 14)
    percent, lengths = t_rel(segments(estimate, truth))
    path = float(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1).sum())
    assert 1.0 < path < 100.0
    assert lengths == pytest.approx([path * k / 10 for k in range(1, 9)])
    assert percent == pytest.approx(kitti_loop(estimate, truth, lengths, 1))


def test_a_scale_error_is_its_t_rel() -> None:
    n = 50
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 2, 3] = np.arange(n) * 0.5
    truth = Trajectory(np.arange(n) * NS // 10, poses)
    longer = poses.copy()
    longer[:, 2, 3] *= 1.03
    percent, _ = t_rel(segments(Trajectory(truth.stamps, longer), truth))
    assert percent == pytest.approx(3.0, abs=0.5)  # segments end at the first pose beyond their length


@pytest.mark.parametrize("poses", [0, 1, 2])
def test_too_little_gives_none_not_numbers(poses: int) -> None:
    truth = walk(1)
    scores = score(truth.at(np.arange(poses)), truth)
    assert scores.pairs == poses
    assert scores.ate_se3_m is scores.ate_sim3_m is scores.scale_ratio is scores.rpe_trans_m is None
    assert scores.scale_ratio_halves == [None, None]


def test_an_estimate_that_stands_still_has_no_scale() -> None:
    truth = walk(1)
    still = Trajectory(truth.stamps, np.tile(np.eye(4), (len(truth), 1, 1)))
    scores = score(still, truth)
    assert scores.scale_ratio is None
    assert scores.rpe_trans_m is not None
    assert scores.t_rel_percent == pytest.approx(100.0, abs=30.0)


def test_a_path_too_short_has_no_t_rel() -> None:
    truth = walk(1, step_m=0.0001)
    assert t_rel(segments(truth, truth)) == (None, [])
    assert r_rel(segments(truth, truth)) is None


def test_the_segments_of_a_trajectory_are_formed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    formed = []
    whole = scores._relative_errors
    monkeypatch.setattr(scores, "_relative_errors", lambda *given: formed.append(given) or whole(*given))
    found = score(walk(13), walk(13))
    assert len(formed) == 1 + len(found.t_rel_lengths_m), "for rpe, and each length"


def test_a_path_that_holds_one_hundred_metres_is_measured_by_the_benchmark_s_length() -> None:
    along = np.tile(np.eye(4), (151, 1, 1))
    along[:, 0, 3] = np.arange(151.0)
    path = Trajectory(np.arange(151) * NS // 10, along)
    assert [length for length, _ in segments(path, path)] == [100.0]
