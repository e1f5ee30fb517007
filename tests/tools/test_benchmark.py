"""The benchmark's tables, over an evaluation that only pretends."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from prism_edge.evaluation.metrics import versions
from tests.tools.runs import metrics_of
from tools import benchmark, finished_runs
from tools.published_figures import published

# Frames of what is played; 40 where nothing fits.
LENGTHS = {"freiburg1_xyz": 798, "seq-01": 1000, "sequences/03": 500, "sequences_whole/03": 801}


def layout(folder: Path, kind: str) -> Path:
    """As little of a dataset as is needed for it to be recognised."""
    folder.mkdir(parents=True)
    if kind == "tum":
        (folder / "rgb").mkdir()
        (folder / "rgb" / "1.0.png").write_bytes(b"")
        (folder / "rgb.txt").write_text("1.0 rgb/1.0.png\n")
    elif kind == "scenes":
        (folder / "frame-000000.color.png").write_bytes(b"")
    elif kind == "kitti":
        (folder / "image_2").mkdir()
        (folder / "image_2" / "000000.png").write_bytes(b"")
        (folder / "calib.txt").write_text("P2: 1 0 0 0 0 1 0 0 0 0 1 0\n")
        (folder / "times.txt").write_text("0.0\n")
    return folder


@pytest.fixture
def ran(monkeypatch) -> list[list[str]]:
    """What `eval` is given; it finds errors of (seed + 1) cm, and no image in a folder called `broken`."""
    given: list[list[str]] = []

    def evaluate(words: list[str]) -> int:
        given.append(words)
        option = {w: words[i + 1] for i, w in enumerate(words[:-1]) if w.startswith("--")}
        if "broken" in words[1]:
            print("prism-edge: error: there is no | image", file=sys.stderr)
            return 4
        metres = 0.01 * (int(option["--seed"]) + 1)
        errors: dict[str, object] = {"ate_sim3_m": metres, "ate_se3_m": 2 * metres, "t_rel_percent": 1.5}
        lengths = [7.0, 14.0] if "stroll" in words[1] else [100.0, 200.0]
        errors |= {"r_rel_deg_per_100m": 0.25, "t_rel_lengths_m": lengths}
        report = {
            **metrics_of(words),
            "frames": next((n for name, n in LENGTHS.items() if name in words[1]), 40),
            "path_m": 7.06,
            "coverage": 0.5,
            "tracked": 100,
            "unreadable_frames": 30 if "damaged" in words[1] else 0,
            "live": {**errors, "pairs": 99},
            "final": {**errors, "ate_se3_m": None, "pairs": 29 if "torn" in words[1] else 99},
            "unscored": "no pose | came" if "silent" in words[1] else None,
            "warnings": ["3 of 100 poses have a true one"] if "elsewhen" in words[1] else [],
        }
        Path(option["--out"]).mkdir(parents=True, exist_ok=True)
        (Path(option["--out"]) / "metrics.json").write_text(json.dumps(report))
        if report["unscored"]:
            print(f"prism-edge: error: the run can't be scored: {report['unscored']}", file=sys.stderr)
            return 8
        return 0

    monkeypatch.setattr(benchmark, "prism_edge", evaluate)
    return given


def row(output: str, name: str) -> list[str]:
    found = [line for line in output.splitlines() if line.startswith("|") and name in line]
    assert len(found) == 1
    return [cell.strip() for cell in found[0].strip("|").split("|")]


def test_ours_and_the_papers_figures_are_side_by_side_and_labelled(tmp_path: Path, ran, capsys):
    folders = [
        layout(tmp_path / "tum" / "rgbd_dataset_freiburg1_xyz", "tum"),
        layout(tmp_path / "bonn" / "rgbd_bonn_balloon2", "tum"),
        layout(tmp_path / "7scenes_redkitchen" / "seq-01", "scenes"),
        layout(tmp_path / "sequences" / "03", "kitti"),
        layout(tmp_path / "mine" / "desk", "tum"),
    ]
    words = [*map(str, folders), "--model", "net.onnx", "--out", str(tmp_path / "out"), "--runs", "3"]
    assert benchmark.main(words) == 0
    out, err = capsys.readouterr()
    assert len(ran) == 15
    # Medians of three runs: 2 cm; the paper's in the columns that say so.
    ours = ["0.500", "99 of 100", "2.0 / 4.0", "2.0 / -", "1.50", "0.25"]
    first = "tum/rgbd_dataset_freiburg1_xyz (fr1/xyz)"
    assert row(out, "freiburg1_xyz") == [first, "798", "7.1", *ours, "2.86 / 3.04", "-"]
    assert row(out, "balloon2")[-2:] == ["14 / 17.7†", "-"]
    assert row(out, "seq-01")[-2:] == ["3.6 / 12.1", "-"]
    metres = ["0.0 / 0.0", "0.0 / -", "1.50", "0.25", "- / 4.3", "2.29"]
    assert row(out, "sequences/03") == ["sequences/03 (seq 03)", "500", "7.1", "0.500", "99 of 100", *metres]
    assert row(out, "desk")[-2:] == ["-", "-"]
    assert "### BONN Dynamic" in out
    assert out.count("*paper*: ATE") == 4
    assert "not measured here" in out
    assert "[5/5]" in err


def test_a_cut_of_a_sequence_whose_length_nobody_noted_has_no_figures_beside_it(tmp_path: Path, ran, capsys):
    folder = layout(tmp_path / "rgbd_dataset_freiburg3_walking_static", "tum")
    words = [str(folder), "--model", "net.onnx", "--out", str(tmp_path / "out"), "--frames", "40"]
    assert benchmark.main(words) == 0
    out = capsys.readouterr().out
    assert row(out, "walking_static")[-2:] == ["-", "-"]
    assert "walking_static has 40 frames, and the paper's figures are of all: they are left out.\n" in out
    assert "†" not in out


def test_the_papers_figures_stand_beside_recordings_of_their_length_alone(tmp_path: Path, ran, capsys):
    folders = [
        layout(tmp_path / "cut" / "rgbd_dataset_freiburg1_rpy", "tum"),
        layout(tmp_path / "rgbd_dataset_freiburg3_walking_static", "tum"),
        layout(tmp_path / "sequences_whole" / "03", "kitti"),
    ]
    words = [*map(str, folders), "--model", "net.onnx", "--out", str(tmp_path / "out"), "--frames", "801"]
    assert benchmark.main(words) == 0
    assert all(words[words.index("--frames") + 1] == "801" for words in ran)
    out = capsys.readouterr().out
    assert row(out, "freiburg1_rpy")[-2:] == row(out, "sequences_whole/03")[-2:] == ["-", "-"]
    assert row(out, "walking_static")[-2:] == ["1.9 / 2.7†", "-"]
    assert "\ncut/rgbd_dataset_freiburg1_rpy has 40 frames, and the paper's figures are of 723: they" in out
    assert "\nsequences_whole/03 has 801 frames, and the paper's figures are of 500: they are left out" in out
    assert out.count("\n† Of a sequence whose number of frames") == 1


def test_a_note_on_the_papers_figures_stands_where_there_are_any(tmp_path: Path, ran, capsys):
    for place in ("sequences/03", "sequences/07"):
        folder = layout(tmp_path / place, "kitti")
        assert benchmark.main([str(folder), "--model", "net.onnx", "--out", str(tmp_path / "out")]) == 0
        assert ("of the first 500 frames" in capsys.readouterr().out) == place.endswith("03")


def test_a_folder_that_fails_has_the_reason_in_its_line_and_the_others_go_on(tmp_path: Path, ran, capsys):
    folders = [tmp_path / "broken", layout(tmp_path / "desk", "tum")]
    words = [*map(str, folders), "--model", "net.onnx", "--out", str(tmp_path / "out"), "--lockstep"]
    assert benchmark.main(words) == 1
    out = capsys.readouterr().out
    assert row(out, "broken")[1] == "failed: there is no / image"
    assert row(out, "desk")[3] == "0.500"
    assert len(row(out, "desk")) == len(row(out, "broken"))
    assert all("--lockstep" in words for words in ran)


def test_a_run_with_nothing_to_score_fails_new_or_kept_and_is_not_repeated(tmp_path: Path, ran, capsys):
    words = [str(layout(tmp_path / "silent", "tum")), "--model", "net.onnx", "--out", str(tmp_path / "out")]
    for there in ("", " that was there already"):
        assert benchmark.main(words) == 1
        cells = row(capsys.readouterr().out, "silent")
        assert cells[1] == f"failed: the run{there} can't be scored: no pose / came"
    assert len(ran) == 1


def test_what_a_run_warns_of_is_said_below_its_table(tmp_path: Path, ran, capsys):
    folders = [layout(tmp_path / name, "tum") for name in ("elsewhen", "desk")]
    words = [*map(str, folders), "--model", "net.onnx", "--out", str(tmp_path / "out"), "--runs", "2"]
    assert benchmark.main(words) == 0
    assert capsys.readouterr().out.count("/elsewhen: 3 of 100 poses have a true one.\n") == 1


def test_what_is_said_below_a_table_names_the_scene_as_the_table_does(tmp_path: Path, ran, capsys):
    folders = [layout(tmp_path / scene / "seq-09", "scenes") for scene in ("chess", "fire")]
    assert benchmark.main([*map(str, folders), "--model", "net.onnx", "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    for scene in ("chess", "fire"):
        assert row(out, f"{scene}/seq-09")
        assert f"\n{scene}/seq-09 has 40 frames" in out


def test_poses_that_came_with_a_loop_count_among_the_final_ones():
    found = benchmark.Row(Path("desk"), "TUM RGB-D")
    found.runs.append({"live": {"pairs": 30}, "final": {"pairs": 45}, "tracked": 30, "final_later": 15})
    assert benchmark._met(found) == "30 of 30 and 45 of 45"
    del found.runs[0]["final_later"]  # a run of an earlier build
    assert benchmark._met(found) == "30 and 45 of 30"


def test_no_figures_of_the_paper_stand_beside_a_run_that_failed(tmp_path: Path):
    folder = layout(tmp_path / "sequences" / "03", "kitti")
    failed = benchmark.Row(folder, benchmark.row_of(folder).dataset, failure="its calib.txt lacks P2")
    assert benchmark.line(failed).split(" | ")[-2:] == ["-", "- |"]


def test_what_a_progress_bar_tells_a_terminal_is_no_part_of_an_error(tmp_path: Path, capsys, monkeypatch):
    def evaluate(words: list[str]) -> int:
        print("\x1b[2K\x1b[?25hprism-edge: error: there is no image", file=sys.stderr)
        return 4

    monkeypatch.setattr(benchmark, "prism_edge", evaluate)
    words = [str(layout(tmp_path / "desk", "tum")), "--model", "net.onnx", "--out", str(tmp_path / "out")]
    assert benchmark.main(words) == 1
    assert row(capsys.readouterr().out, "desk")[1] == "failed: there is no image"


def test_a_machine_that_others_used_is_said(tmp_path: Path, ran, capsys):
    row = benchmark.Row(tmp_path / "desk", "TUM RGB-D")
    for mode, share in (("realtime", 0.2), ("realtime", 0.0), ("realtime", None), ("lockstep", 0.2)):
        row.runs.append({"foreign_cpu": share, "config": {"mode": mode}})
    (said,) = benchmark.warnings(row)
    assert "others used the machine during 1 of 4 run(s)" in said


def test_drift_over_a_short_paths_own_length_is_starred(tmp_path: Path, ran, capsys):
    folders = [layout(tmp_path / name, "tum") for name in ("stroll", "drive")]
    assert benchmark.main([*map(str, folders), "--model", "net.onnx", "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert row(out, "stroll")[-4:-2] == ["1.50\\*", "0.25\\*"]
    assert row(out, "drive")[-4:-2] == ["1.50", "0.25"]
    assert out.count("\n\\* over shares of a path that holds no 100 m") == 1


def test_frames_that_were_not_played_stand_beside_the_coverage(tmp_path: Path, ran, capsys):
    words = [str(layout(tmp_path / "damaged", "tum")), "--model", "net.onnx", "--out", str(tmp_path / "out")]
    assert benchmark.main(words) == 0
    assert row(capsys.readouterr().out, "damaged")[3] == "0.500 (30 not played)"


def test_final_errors_over_fewer_frames_say_so(tmp_path: Path, ran, capsys):
    words = [str(layout(tmp_path / "torn", "tum")), "--model", "net.onnx", "--out", str(tmp_path / "out")]
    assert benchmark.main(words) == 0
    assert row(capsys.readouterr().out, "torn")[4] == "99 and 29 of 100"


def test_a_finished_run_with_the_same_settings_is_not_repeated(tmp_path: Path, ran, capsys):
    folder = layout(tmp_path / "desk", "tum")
    words = [str(folder), "--out", str(tmp_path / "out"), "--model"]
    assert benchmark.main([*words, "net.onnx"]) == 0
    assert benchmark.main([*words, "net.onnx"]) == 0
    assert len(ran) == 1
    assert "/desk: 1 of 1 run(s) were there already, of this version" in capsys.readouterr().out
    assert benchmark.main([*words, "other.onnx"]) == 0
    assert len(ran) == 2
    assert benchmark.main([*words, "other.onnx", "--lockstep"]) == 0
    assert len(ran) == 3
    (metrics,) = (tmp_path / "out").glob("*realtime*/metrics.json")
    metrics.write_text('{"config": ')  # cut off in the middle
    assert benchmark.main([*words, "other.onnx"]) == 0
    assert len(ran) == 4


def test_a_run_of_another_version_or_older_network_is_repeated(tmp_path: Path, ran, capsys, monkeypatch):
    network = tmp_path / "net.onnx"
    network.touch()
    os.utime(network, (1e9, 1e9))
    words = [str(layout(tmp_path / "desk", "tum")), "--out", str(tmp_path / "out"), "--model", str(network)]
    assert [benchmark.main(words) for _ in range(2)] == [0, 0]
    assert len(ran) == 1
    network.write_bytes(b"another")
    os.utime(network, (1e9, 1e9))
    assert benchmark.main(words) == 0
    assert len(ran) == 2
    monkeypatch.setattr(finished_runs, "versions", lambda: {**versions(), "prism_edge": "99"})
    assert benchmark.main(words) == 0
    assert len(ran) == 3
    assert "were there already" not in capsys.readouterr().out.rpartition("`prism_edge` with")[2]


def test_folders_that_would_share_a_place_are_refused(tmp_path: Path, ran, capsys):
    folders = [tmp_path / n / "a" / "b" / "c" for n in "xy"]
    with pytest.raises(SystemExit):
        benchmark.main([*map(str, folders), "--model", "net.onnx"])
    assert "end alike" in capsys.readouterr().err
    assert not ran


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["sim:room?seed=3"], "sim:room?seed=3 is no folder: `prism-edge eval` scores simulated worlds"),
        (["seq-01", "--runs", "0"], "--runs: expected a whole number above 0, and below 2^31, got '0'"),
    ],
)
def test_what_can_not_be_run_is_refused_in_one_line(ran, capsys, words: list[str], said: str):
    with pytest.raises(SystemExit):
        benchmark.main([*words, "--model", "net.onnx"])
    assert capsys.readouterr().err.endswith(f"{said}\n")
    assert not ran


@pytest.mark.parametrize(
    ("dataset", "folder", "expected"),
    [
        ("BONN Dynamic", "rgbd_bonn_balloon", 9.8),
        ("BONN Dynamic", "rgbd_bonn_balloon_tracking2", None),
        ("TUM RGB-D", "rgbd_dataset_freiburg3_walking_xyz", 23.2),
        ("TUM RGB-D", "rgbd_dataset_freiburg3_walking_xyz_validation", None),
        ("7-Scenes", "office/seq-03", 11.7),
        ("7-Scenes", "office/seq-03/seq-03", 11.7),
        ("7-Scenes", "chess", 7.1),
        ("KITTI odometry", "office/seq-03", None),
    ],
)
def test_a_figure_of_the_paper_goes_with_its_sequence_alone(dataset, folder, expected):
    found = published(dataset, Path("/data") / folder)
    assert (found.sim3_cm if found else None) == expected


def test_a_link_keeps_its_name_by_which_the_dataset_is_known(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "d" / "balloon").mkdir(parents=True)
    link = tmp_path / "rgbd_bonn_balloon"
    link.symlink_to(tmp_path / "d" / "balloon")
    monkeypatch.chdir(tmp_path)
    assert benchmark.as_named(Path("d/../rgbd_bonn_balloon")) == link
    monkeypatch.setenv("HOME", str(tmp_path))
    assert benchmark.as_named(Path("~/rgbd_bonn_balloon")) == link


def test_a_pair_of_networks_is_named_as_one(tmp_path: Path, ran, capsys):
    folder = layout(tmp_path / "mine" / "desk", "tum")
    pair = "nested:/far/relative.onnx,/far/net.onnx"
    words = [str(folder), "--model", pair, "--out", str(tmp_path / "out")]
    assert benchmark.main(words) == 0
    assert "`prism_edge` with nested:relative.onnx,net.onnx, " in capsys.readouterr().out
