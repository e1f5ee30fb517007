"""metrics.json holds what its contract says, whatever is missing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from prism_edge.config import Config, DepthConfig, SourceConfig
from prism_edge.evaluation.metrics import metrics
from prism_edge.evaluation.played import Played
from prism_edge.evaluation.recording import Published, Recording
from prism_edge.evaluation.resources import Usage
from prism_edge.evaluation.table import show
from prism_edge.evaluation.trajectory import NS, Trajectory
from prism_edge.messages import INITIALISING, OK, EndOfStream, MapSnapshot, Tracked

# What others script against (the `eval` contract).
KEYS = {
    *("frames", "tracked", "coverage", "first_pose_s", "ready_s", "live", "final", "cpu_ms_per_frame"),
    *("latency_ms", "fps", "dropped_frames", "duplicate_frames", "peak_pss_mb", "foreign_cpu", "keyframes"),
    *("map_points", "seed", "versions", "config", "timings_void"),
}
ERRORS = {
    *("ate_se3_m", "ate_sim3_m", "scale_ratio", "scale_ratio_halves", "rpe_trans_m", "rpe_rot_deg"),
    *("t_rel_percent", "r_rel_deg_per_100m"),
}
N = 60


def circle(scale: float) -> Trajectory:
    """Two seconds on a quarter of a circle of radius 2 m."""
    angles = np.linspace(0, np.pi / 2, N)
    poses = np.tile(np.eye(4), (N, 1, 1))
    poses[:, 0, 3], poses[:, 1, 3] = 2 * scale * np.cos(angles), 2 * scale * np.sin(angles)
    return Trajectory((np.arange(N) * NS / 30).astype(np.int64), poses)


def report(**changes: Any) -> dict[str, Any]:
    """Metrics of a run whose estimate is 10 % too large, with some inputs changed."""
    estimate = circle(1.1)
    rows = [(int(stamp), pose) for stamp, pose in zip(estimate.stamps, estimate.poses, strict=True)]
    recording = Recording(
        [Published(stamp, stamp + 5_000_000, pose) for stamp, pose in rows],
        [Tracked(i, stamp, stamp, OK, True, -1, 0, np.eye(4), 0) for i, (stamp, _) in enumerate(rows)],
        [stamp for stamp, _ in rows],
        EndOfStream(N, N, 0, 0, N - 1),
    )
    ids = np.zeros(1, np.int64)
    inputs: dict[str, Any] = {
        "config": Config(seed=3),
        "recording": recording,
        "snapshot": MapSnapshot(0, 4, True, 0.05, ids, np.eye(4)[None], np.arange(7)),
        "usage": Usage({"tracker": 0.6, "source": 0.3}, {"tracker": 90.0, "source": 60.0}, 140.0, 0.02),
        "ready_s": 0.9,
        "first_stamp_ns": 0,
        "live": estimate,
        "final": estimate,
        "final_missing": 0,
        "truth": circle(1.0),
        "truth_name": "the sequence's own",
        "played": Played(),
    }
    return metrics(**(inputs | changes))


def test_every_key_of_the_contract_is_there() -> None:
    found = report()
    assert set(found) >= KEYS
    assert set(found["live"]) >= ERRORS
    assert set(found["final"]) >= ERRORS
    json.dumps(found, allow_nan=False)


def test_keyframes_that_only_carry_frames_are_none_of_the_map() -> None:
    ids = np.arange(5)
    held = MapSnapshot(0, 4, True, 0.05, ids, np.tile(np.eye(4), (5, 1, 1)), np.arange(7), carried=3)
    assert report(snapshot=held)["keyframes"] == 2


def test_figures_of_a_run_without_surprises() -> None:
    found = report()
    assert found["coverage"] == 1.0
    assert found["live"]["scale_ratio"] == pytest.approx(1 / 1.1)
    assert found["live"]["scale_ratio_halves"] == [pytest.approx(1 / 1.1)] * 2
    assert found["live"]["ate_sim3_m"] == pytest.approx(0.0, abs=1e-9)
    assert found["latency_ms"] == {"p50": 5.0, "p95": 5.0, "p99": 5.0}
    expected = {"tracker": pytest.approx(10.0), "source": pytest.approx(5.0), "total": pytest.approx(15.0)}
    assert found["cpu_ms_per_frame"] == expected
    assert found["peak_pss_mb"] == {"tracker": 90.0, "source": 60.0, "total": 140.0}
    assert (found["keyframes"], found["map_points"], found["seed"]) == (1, 7, 3)
    assert found["timings_void"] is False
    assert found["path_m"] == pytest.approx(np.pi, rel=1e-3)
    assert found["config"]["tracking"]["features"] == Config().tracking.features


@pytest.mark.parametrize(("foreign", "void"), [(0.1, False), (0.11, True), (None, True)])
def test_timings_are_void_when_others_were_busy(foreign: float | None, void: bool) -> None:
    assert report(usage=Usage({}, {}, None, foreign))["timings_void"] is void


def test_what_is_not_known_is_null(capsys: pytest.CaptureFixture[str], tmp_path: Any) -> None:
    empty = Trajectory.of([])
    found = report(
        recording=Recording(),
        snapshot=None,
        usage=Usage({}, {}, None, None),
        ready_s=None,
        first_stamp_ns=None,
        live=empty,
        final=empty,
        truth=None,
    )
    assert set(found) >= KEYS
    json.dumps(found, allow_nan=False)
    nulls = ("coverage", "first_pose_s", "ready_s", "fps", "foreign_cpu", "keyframes", "map_points", "truth")
    for key in nulls:
        assert found[key] is None, key
    assert found["cpu_ms_per_frame"] == {"total": None}
    assert found["peak_pss_mb"] == {"total": None}
    assert all(found["live"][key] in (None, [None, None]) for key in ERRORS)
    show(found, tmp_path)
    assert "no truth" in capsys.readouterr().out


def test_a_map_of_no_numbers_is_null_not_a_crash(tmp_path: Any) -> None:
    ids = np.zeros(1, np.int64)
    broken = MapSnapshot(0, 4, True, np.nan, ids, np.eye(4)[None], ids)
    found = report(snapshot=broken)
    assert found["log_scale"] is None
    json.dumps(found, allow_nan=False)
    tracked = Tracked(0, 0, 0, OK, True, -1, 0, np.eye(4), 0)
    final, missing = Recording([Published(0, 0, np.eye(4))], [tracked]).final(broken, np.eye(4))
    assert (len(final), missing) == (0, 1)


def test_figures_that_json_has_no_word_for_are_null_however_deep_they_lie() -> None:
    usage = Usage({"tracker": float("inf")}, {"tracker": float("nan"), "source": 60.0}, 140.0, 0.02)
    found = report(usage=usage)
    assert found["cpu_ms_per_frame"] == {"tracker": None, "total": None}
    assert found["peak_pss_mb"] == {"source": 60.0, "tracker": None, "total": 140.0}
    json.dumps(found, allow_nan=False)


def test_truth_of_another_time_is_said(capsys: pytest.CaptureFixture[str], tmp_path: Any) -> None:
    truth = circle(1.0)
    later = report(truth=Trajectory(truth.stamps + 1_000_000_000 * NS, truth.poses))
    show(later, tmp_path)
    shown = capsys.readouterr().out
    assert "0 of 60" in shown
    assert "warning: 0 of 60 poses have a true one at their time" in shown
    assert "the poses are of 0.000 to 1.967 s, the 60 true ones of 1000000000.000 to" in shown
    few = report(truth=truth.at(np.arange(N) < 29), live=circle(1.1).at(np.arange(N) >= 20))
    assert few["live"]["pairs"] == 9
    assert len(few["warnings"]) == 1


def test_sparse_truth_that_is_all_met_is_no_cause_to_warn() -> None:
    assert report(truth=circle(1.0).at(np.arange(0, N, 10)))["warnings"] == []
    assert report()["warnings"] == []
    assert report()["unscored"] is None


def test_truth_of_what_was_not_played_is_in_no_count() -> None:
    truth = circle(1.0)
    more = truth.stamps[-1] + 1_000_000_000 + (np.arange(200) * NS / 30).astype(np.int64)
    stamps = np.concatenate([truth.stamps[::10], more])
    whole = Trajectory(stamps, np.concatenate([truth.poses[::10], np.tile(np.eye(4), (200, 1, 1))]))
    assert len(report(truth=whole)["warnings"]) == 1
    beginning = Config(source=SourceConfig(frames=N))
    assert report(truth=whole, config=beginning)["warnings"] == []
    later = Trajectory(truth.stamps + 1_000_000_000 * NS, truth.poses)
    assert len(report(truth=later, config=beginning)["warnings"]) == 1


def test_what_a_camera_s_images_say_against_it_is_a_warning() -> None:
    assert report(played=Played(doubts=("rolling shutter: ...",)))["warnings"] == ["rolling shutter: ..."]


def test_a_run_with_nothing_to_score_says_so() -> None:
    empty = Trajectory.of([])
    network = Config(depth=DepthConfig(model="net.onnx"))
    silent = report(config=network, live=empty, final=empty)
    assert silent["warnings"] == ["no pose came out of 60 frames"]
    assert silent["unscored"] == "no pose came out of 60 frames"
    why = report(config=network, live=empty, final=empty, played=Played(no_depth="constant"))
    assert why["unscored"] == "no pose came out of 60 frames: keyframes had no usable depth: constant"
    dark = [Tracked(i, i, i, INITIALISING, False, -1, -1, np.eye(4)) for i in range(N)]
    ended = EndOfStream(N, N, 0, 0, N - 1)
    for frames, said in ((dark, True), ([*dark[:-1], replace(dark[-1], keyframe=0)], False)):
        recording = Recording(frames=frames, end=ended)
        unseen = report(config=network, live=empty, final=empty, recording=recording)
        assert ("corners" in unseen["unscored"]) == said, "a keyframe has some"
    refused = Recording(end=EndOfStream(N, N - 20, 0, 20, N - 1))
    unplayed = report(config=network, live=empty, final=empty, recording=refused)["unscored"]
    assert unplayed.startswith("no pose came out of 60 frames; 20 of 60 frames were not played")
    assert report(live=empty, final=empty)["unscored"] is None, "without a network none is due"
    truth = circle(1.0)
    elsewhen = report(config=network, truth=Trajectory(truth.stamps + 9 * NS, truth.poses))
    assert elsewhen["unscored"] == elsewhen["warnings"][0]
    assert elsewhen["unscored"].startswith("0 of 60 poses have a true one at their time")
    assert report(config=network, truth=None)["unscored"] is None


@pytest.mark.parametrize(("refused", "said"), [(0, 0), (6, 0), (7, 1)])
def test_frames_that_were_not_played_are_said(
    refused: int, said: int, capsys: pytest.CaptureFixture[str], tmp_path: Any
) -> None:
    recording = Recording(end=EndOfStream(600, 600 - refused, 0, refused, 599))
    found = report(recording=recording)
    assert len([text for text in found["warnings"] if "were not played" in text]) == said
    show(found, tmp_path)
    assert f"{refused} (unreadable, wrong size or stamp)" in capsys.readouterr().out


def test_a_guessed_camera_is_said(capsys: pytest.CaptureFixture[str], tmp_path: Any) -> None:
    camera = {"origin": "a Kinect's (a guess)", "fx": 525.0}
    guessed = report(played=Played(camera, "TUM RGB-D", "desk/groundtruth.txt", guessed=True))
    assert guessed["camera"] == camera
    assert (guessed["layout"], guessed["truth_file"]) == ("TUM RGB-D", "desk/groundtruth.txt")
    assert guessed["warnings"] == ["nothing says which camera took the recording: a Kinect's (a guess)"]
    show(guessed, tmp_path)
    shown = capsys.readouterr().out
    assert "camera: a Kinect's (a guess)" in shown
    assert "scored against the sequence's own (desk/groundtruth.txt)" in shown
    assert report(played=Played(camera))["warnings"] == []


def test_what_the_map_says_of_its_camera_is_told(capsys: pytest.CaptureFixture[str], tmp_path: Any) -> None:
    ids, six = np.zeros(1, np.int64), [640.0, 480.0, 525.0, 525.0, 319.5, 239.5]
    nothing = {"k1": None, "readout_ms": None}
    for file, now, readout_ms, found, words in (
        ((), (), 0.0, nothing, "camera: camera.yaml\n"),
        ((0.1, -0.2, 0.0, 0.0), (0.1, -0.2, 0.0, 0.0), -9.0, nothing | {"readout_ms": -9.0}, "over -9.0 ms"),
        ((), (-0.0203, 0.0, 0.0, 0.0), 0.0, nothing | {"k1": -0.0203}, "; found in the map: k1 -0.0203\n"),
        (None, (0.03,), 25.2, {"k1": 0.03, "readout_ms": 25.2}, ": k1 0.0300, rows read over 25.2 ms"),
        ((-0.1,), (), 0.0, nothing | {"k1": 0.0}, ": k1 0.0000\n"),
    ):
        said, camera = {"origin": "camera.yaml", "distortion": file}, np.array([*six, *now])
        map_of_it = MapSnapshot(0, 4, True, 0.0, ids, np.eye(4)[None], ids, camera=camera)
        snapshot = replace(map_of_it, readout_ms=readout_ms)
        told = report(played=Played(said), snapshot=snapshot)
        assert told["camera_found"] == found
        assert told["camera"]["origin"] == "camera.yaml"
        show(told, tmp_path)
        assert words in capsys.readouterr().out
    assert report(snapshot=None)["camera_found"] == nothing


@pytest.mark.parametrize("name", ["try[office]", "to[/x", ":fire:"])
def test_a_path_is_shown_as_it_is(name: str, capsys: pytest.CaptureFixture[str], tmp_path: Any) -> None:
    show(report(), tmp_path / name)
    assert capsys.readouterr().out.endswith(f"written to {tmp_path / name}\n")


def test_final_errors_over_fewer_frames_are_said(capsys: pytest.CaptureFixture[str], tmp_path: Any) -> None:
    torn = report(final=circle(1.1).at(np.arange(N) < 33), final_missing=27)
    assert torn["warnings"] == ["27 of 60 tracked frames are not in the finished map (final.tum)"]
    show(torn, tmp_path)
    assert "33 of 60" in capsys.readouterr().out


def test_a_dataset_without_its_truth_is_said_and_a_recording_of_ones_own_is_not() -> None:
    (said,) = report(truth=None, played=Played(layout="KITTI odometry"))["warnings"]
    assert "nothing is scored" in said
    assert "data_odometry_poses.zip" in said
    assert report(truth=None, played=Played(layout="video file"))["warnings"] == []
    assert report(played=Played(layout="KITTI odometry"))["warnings"] == []


def test_a_map_that_was_still_being_adjusted_is_said() -> None:
    ids = np.zeros(1, np.int64)
    taken = MapSnapshot(0, 4, False, 0.0, ids, np.eye(4)[None], ids)
    (said,) = report(snapshot=taken)["warnings"]
    assert "still being adjusted" in said
    assert report(snapshot=None)["warnings"] == []


@pytest.mark.parametrize(("radius", "starred"), [(1.0, True), (100.0, False)])
def test_drift_over_a_paths_own_length_is_starred(
    radius: float, starred: bool, capsys: pytest.CaptureFixture[str], tmp_path: Any
) -> None:
    found = report(live=circle(1.1 * radius), final=circle(1.1 * radius), truth=circle(radius))
    show(found, tmp_path)
    shown = capsys.readouterr().out
    assert ("* over shares of a path that holds no 100 m" in shown) is starred
    for name in ("t_rel", "r_rel"):
        (line,) = [line for line in shown.splitlines() if line.startswith(f"│ {name} ")]
        assert line.count(" *") == 2 * starred


def test_the_table_shows_the_figures(capsys: pytest.CaptureFixture[str], tmp_path: Any) -> None:
    show(report(), tmp_path)
    shown = capsys.readouterr().out
    assert "60 of 60" in shown
    assert "warning" not in shown
    assert "0.909" in shown  # scale ratio
    assert "15 ms" in shown
    assert "140 MB" in shown


def test_the_tables_errors_are_in_the_units_that_it_names(
    capsys: pytest.CaptureFixture[str], tmp_path: Any
) -> None:
    scores = {"ate_se3_m": 0.0123, "ate_sim3_m": 0.0045, "scale_ratio": 0.98, "rpe_trans_m": 0.067}
    scores |= {"rpe_rot_deg": 0.89, "t_rel_percent": 1.5, "r_rel_deg_per_100m": 2.5}
    found = report()
    found["live"] |= scores
    show(found, tmp_path)
    rows = [[cell.strip() for cell in line.split("│")[1:3]] for line in capsys.readouterr().out.splitlines()]
    for row in (
        ["ATE SE(3)", "1.23 cm"],
        ["ATE Sim(3)", "0.45 cm"],
        ["scale ratio", "0.98"],
        ["RPE over 1 s", "6.7 cm"],
        ["RPE over 1 s", "0.89 deg"],
        ["t_rel", "1.5 % *"],  # of a path shorter than 100 m
        ["r_rel", "2.5 deg/100 m *"],
    ):
        assert row in rows


@pytest.mark.parametrize(("model", "monocular"), [("", True), ("network.onnx", True), ("sensor", False)])
def test_whether_one_camera_did_it_alone_is_said(model: str, monocular: bool) -> None:
    assert report(config=Config(depth=DepthConfig(model=model)))["monocular"] is monocular


def test_frames_that_a_loop_has_placed_since_are_said(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    known = circle(1.1)
    both = Trajectory(np.concatenate([known.stamps, known.stamps + 60 * NS]), np.tile(known.poses, (2, 1, 1)))
    found = report(final=both, truth=both)
    assert (found["tracked"], found["final_later"]) == (N, N)
    assert any(text.startswith(f"{N} frames without a pose as they came") for text in found["warnings"])
    show(found, tmp_path)
    assert f"{2 * N} of {2 * N}" in capsys.readouterr().out
    assert report()["final_later"] == 0
    assert not any("as they came" in text for text in report()["warnings"])


def test_kilometres_are_written_out(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    show(report() | {"path_m": 3724.2}, tmp_path)
    assert "3724 m" in capsys.readouterr().out
