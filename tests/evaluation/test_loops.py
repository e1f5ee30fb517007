"""Loops against the truth."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.evaluation.loops import judge_loops, pose_at
from prism_edge.evaluation.trajectory import Trajectory
from prism_edge.geometry.poses import inverse, se3_exp
from prism_edge.messages import MapSnapshot, Tracked

STEP = np.array([0.1, 0.0, 0.05, 0.0, 0.02, 0.0])
TRUTH = Trajectory.of((i * 100_000_000, se3_exp(STEP * i)) for i in range(100))
FRAMES = [Tracked(i, i * 100_000_000, 0, "ok", True, -1, 0, np.eye(4)) for i in range(200)]


def snapshot(*loops: tuple[int, int, np.ndarray], log_scale: float = 0.0) -> MapSnapshot:
    return MapSnapshot(
        epoch=0,
        sequence=0,
        settled=True,
        log_scale=log_scale,
        keyframes=np.zeros(0, np.int64),
        poses=np.zeros((0, 4, 4)),
        points=np.zeros(0, np.int64),
        loop_queries=np.array([q for q, _, _ in loops], np.int64),
        loop_candidates=np.array([c for _, c, _ in loops], np.int64),
        loop_poses=np.array([p for _, _, p in loops]).reshape(-1, 4, 4),
        loop_inliers=np.full(len(loops), 40, np.int64),
    )


def relative(query: int, candidate: int) -> np.ndarray:
    return inverse(TRUTH.poses[candidate]) @ TRUTH.poses[query]


def test_right_and_wrong_are_told_apart():
    off = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, np.radians(6.0), 0.0]))
    far = relative(60, 50).copy()
    far[:3, 3] += (0.5, 0.0, 0.0)
    three = snapshot((60, 50, relative(60, 50)), (70, 60, relative(70, 60) @ off), (60, 50, far))
    judged = judge_loops(three, FRAMES, TRUTH, None)
    assert [row["right"] for row in judged["list"]] == [True, False, False]
    assert judged["accepted"] == judged["judged"] == 3
    assert judged["precision"] == pytest.approx(1 / 3)
    assert judged["list"][0]["translation_error_m"] == pytest.approx(0.0, abs=1e-9)
    assert judged["list"][1]["rotation_error_deg"] == pytest.approx(6.0, abs=1e-6)
    assert judged["list"][2]["translation_error_m"] == pytest.approx(0.5, abs=1e-9)


@pytest.mark.parametrize("candidate", [59, 20])
def test_a_right_loop_is_as_near_as_its_length_allows(candidate):
    true = relative(60, candidate)
    allowed = 0.2 + 0.1 * np.linalg.norm(true[:3, 3])  # docs/EVALUATION.md
    for shift, right in ((allowed - 0.01, 1.0), (allowed + 0.01, 0.0)):
        pose = true.copy()
        pose[:3, 3] += (0.0, shift, 0.0)
        assert judge_loops(snapshot((60, candidate, pose)), FRAMES, TRUTH, None)["precision"] == right


def test_lengths_are_turned_to_metres():
    pose = relative(60, 20).copy()
    pose[:3, 3] /= 2.0
    halved = snapshot((60, 20, pose), log_scale=np.log(2.0))
    assert judge_loops(halved, FRAMES, TRUTH, None)["precision"] == 1.0
    assert judge_loops(snapshot((60, 20, pose)), FRAMES, TRUTH, None)["precision"] == 0.0


def test_right_places_in_wrong_metres_are_told_from_wrong_places():
    short = relative(60, 20).copy()
    short[:3, 3] *= 0.5
    elsewhere = relative(60, 25)
    judged = judge_loops(snapshot((60, 20, short), (60, 20, elsewhere)), FRAMES, TRUTH, scale_ratio=2.0)
    assert [row["right"] for row in judged["list"]] == [False, False]
    assert [row["same_place"] for row in judged["list"]] == [True, False]
    assert (judged["precision"], judged["place_precision"]) == (0.0, 0.5)


def test_without_a_scale_ratio_places_are_not_judged():
    judged = judge_loops(snapshot((60, 20, relative(60, 20))), FRAMES, TRUTH, None)
    assert judged["precision"] == 1.0
    assert judged["place_precision"] is None


def test_loops_without_a_true_pose_are_listed_but_not_judged():
    judged = judge_loops(snapshot((150, 20, np.eye(4)), (20, 5000, np.eye(4))), FRAMES, TRUTH, None)
    assert judged["accepted"] == 2
    assert judged["judged"] == 0
    assert judged["precision"] is None
    assert judge_loops(snapshot((60, 20, np.eye(4))), FRAMES, None, None)["list"][0]["right"] is None


def test_nothing_heard_is_no_loop():
    assert judge_loops(None, FRAMES, TRUTH, None)["accepted"] == 0
    assert judge_loops(snapshot(), FRAMES, TRUTH, None)["precision"] is None


def test_true_poses_are_interpolated_but_not_across_gaps():
    between = pose_at(TRUTH, 1_030_000_000)
    assert between == pytest.approx(se3_exp(STEP * 10) @ se3_exp(0.3 * STEP), abs=1e-9)
    assert np.array_equal(pose_at(TRUTH, 500_000_000), TRUTH.poses[5])
    sparse = Trajectory.of([(0, np.eye(4)), (3_000_000_000, np.eye(4))])
    assert pose_at(sparse, 1_000_000_000) is None
    assert pose_at(TRUTH, None) is None
    assert pose_at(TRUTH, -5) is None
    assert pose_at(Trajectory.of([]), 5) is None
