"""`prism-edge eval` on a generated recording whose truth is exact: in real time, and twice in lockstep."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from prism_edge.cli.map_opened import opened
from prism_edge.config import Config
from prism_edge.evaluation.trajectory import read_tum
from tests.end_to_end.conftest import FRAMES, SLOW_HZ
from tests.end_to_end.processes import prism_edge

KEYS = {
    *("frames", "tracked", "coverage", "first_pose_s", "ready_s", "live", "final", "cpu_ms_per_frame"),
    *("latency_ms", "fps", "dropped_frames", "duplicate_frames", "peak_pss_mb", "foreign_cpu"),
    *("keyframes", "map_points", "seed", "versions", "config"),
}
SCORES = {
    *("ate_se3_m", "ate_sim3_m", "scale_ratio", "scale_ratio_halves"),
    *("rpe_trans_m", "rpe_rot_deg", "t_rel_percent"),
}
PROCESSES = {"source", "tracker", "depth", "scale", "backend", "supervisor", "total"}


def evaluated(out: Path, room: Path, camera: Path, network: Path, *options: str) -> dict:
    done = prism_edge("eval", room, "--camera", camera, "--model", network, "--out", out, *options)
    assert done.returncode == 0, done.stderr
    return json.loads((out / "metrics.json").read_text())


def test_in_real_time_metres_arrive_and_every_figure_is_there(
    full_size_room: Path, network: Path, tmp_path: Path
) -> None:
    report = evaluated(tmp_path, full_size_room, full_size_room / "camera.yaml", network)
    assert report.keys() >= KEYS
    assert report["frames"] == FRAMES
    # A busy machine drops frames, and those are not the tracker's fault.
    assert report["tracked"] >= 0.8 * (FRAMES - report["dropped_frames"])
    for name in ("live", "final"):
        assert report[name].keys() >= SCORES
        assert report[name]["ate_se3_m"] < 0.02  # of 1 m of path
        assert 0.95 < report[name]["scale_ratio"] < 1.05
    for name in ("cpu_ms_per_frame", "peak_pss_mb"):
        assert report[name].keys() == PROCESSES
        assert all(value > 0 for value in report[name].values())
    assert report["latency_ms"].keys() == {"p50", "p95", "p99"}
    live = read_tum(tmp_path / "live.tum")
    assert len(live) == report["tracked"]
    # The recording's own stamps, to the nanosecond.
    assert np.isin(live.stamps, [round(float(f"{i / SLOW_HZ:.6f}") * 1e9) for i in range(FRAMES)]).all()
    kept = opened(str(tmp_path / "map.prismmap"), Config())
    assert len(kept.world.keyframes) == report["keyframes"]
    final = read_tum(tmp_path / "final.tum")
    for stamp, pose in kept.metric.trajectory(of_base=False):
        if stamp in final.stamps:
            # final.tum carries a frame by the keyframe that it was tracked by, which is an earlier one.
            np.testing.assert_allclose(final.poses[final.stamps == stamp][0], pose, atol=0.02)


def test_in_lockstep_nothing_is_dropped_and_poses_repeat_to_the_last_digit(
    room: Path, camera: Path, network: Path, tmp_path: Path
) -> None:
    options = ("--lockstep", "--seed", "3")
    reports = [evaluated(tmp_path / name, room, camera, network, *options) for name in ("one", "two")]
    for report in reports:
        assert report["dropped_frames"] == 0
        assert report["tracked"] >= FRAMES - 5
        assert report["final"]["ate_se3_m"] < 0.03
        assert report["seed"] == 3
        assert report["final_settled"]
        assert not report["final_missing"]
    for name in ("live.tum", "final.tum"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_without_a_network_there_is_no_metre_but_no_failure_either(
    room: Path, camera: Path, tmp_path: Path
) -> None:
    (tmp_path / "map.prismmap").write_bytes(b"of an earlier run")
    done = prism_edge("eval", room, "--camera", camera, "--out", tmp_path, "--lockstep")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "metrics.json").read_text())
    assert report["dropped_frames"] == 0
    assert report["scale"] is None
    assert not (tmp_path / "map.prismmap").exists()
