"""What is said of a run whose figures say less than they seem to."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from prism_edge.evaluation.doubts import apart_in_time, no_pose
from prism_edge.evaluation.played import Played
from prism_edge.evaluation.trajectory import NS, Trajectory
from prism_edge.geometry.poses import from_rt

LOG = """\
10:00:00.000 INFO    depth: keyframe 0: nothing of interest
10:00:00.100 WARNING depth: keyframe 0 has no depth: constant
10:00:00.200 WARNING depth: keyframe 1 has no depth: only 0 % of the depth map is usable
10:00:01.000 WARNING depth: keyframe 2: a median depth of 2000 m is not within 0.05 and 300 m
10:00:01.500 WARNING scale: keyframe -12: the network's images differ in size by 0.40 (log)
10:00:02.000 WARNING backend: keyframe 4 is incomplete: going on with what there is
"""


def test_a_run_without_a_pose_says_why_its_keyframes_had_no_depth(tmp_path: Path) -> None:
    log = tmp_path / "daemon.log"
    log.write_text(LOG)
    told = Played().after(log)
    assert told.no_depth == "only 0 % of the depth map is usable"
    (what,) = no_pose(0, 250, 250, True, told.no_depth)
    said = "keyframes had no usable depth: only 0 % of the depth map is usable"
    assert what == f"no pose came out of 250 frames: {said}"
    (what,) = no_pose(0, 250, 250, False, told.no_depth)
    assert "corners" in what
    assert no_pose(1, 250, 250, True, told.no_depth) == []


def test_what_depth_and_scale_doubt_of_the_network_is_a_warning_of_the_run(tmp_path: Path) -> None:
    log = tmp_path / "daemon.log"
    log.write_text(LOG)
    assert Played().after(log).doubts == (
        "keyframe 2: a median depth of 2000 m is not within 0.05 and 300 m",
        "keyframe -12: the network's images differ in size by 0.40 (log)",
    )
    assert Played().after(tmp_path / "none.log").doubts == ()


def test_true_poses_after_a_run_that_was_cut_short_are_not_missed() -> None:
    """Ten of a hundred frames were played, and eight poses came of them."""
    truth = Trajectory(np.arange(100) * NS // 10, np.tile(from_rt(np.eye(3), np.zeros(3)), (100, 1, 1)))
    estimate = Trajectory(np.arange(200, dtype=np.int64) * NS // 200, np.tile(np.eye(4), (200, 1, 1)))
    until = int(truth.stamps[9])
    assert apart_in_time(estimate, truth, 10, until) == []
    assert len(apart_in_time(estimate, truth, 10, None)) == 1
