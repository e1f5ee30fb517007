"""What is said of a run whose figures say less than they seem to."""

from __future__ import annotations

from pathlib import Path

from prism_edge.evaluation.doubts import no_pose
from prism_edge.evaluation.played import Played

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
