"""The tables that the ablation tool makes of what was run, and what it runs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from prism_edge.config import ABLATIONS, Config
from prism_edge.evaluation.trajectory import Trajectory, write_tum
from tests.tools.runs import metrics_of, on_a_spiral
from tools import ablate


def write(out: Path, sequence: ablate.Sequence, part: str, seed: int, se3: float | None) -> None:
    folder = ablate.place(out, sequence, part, seed)
    folder.mkdir(parents=True)
    live = {"ate_se3_m": se3, "ate_sim3_m": None if se3 is None else se3 / 2}
    made = metrics_of(ablate.command(out.parent / "shared", out, sequence, part, seed))
    (folder / "metrics.json").write_text(json.dumps({**made, "live": live}))


def test_a_table_has_medians_means_and_differences(tmp_path: Path):
    sequences = ablate.TABLES["static"][1]
    for n, sequence in enumerate(sequences):
        for seed, metres in enumerate((0.02, 0.5, 0.01)):
            write(tmp_path, sequence, "", seed, metres + 0.01 * n)
            write(tmp_path, sequence, "dsug", seed, 2 * metres)
    rows = ablate.table("static", tmp_path, [0, 1, 2]).splitlines()
    full = next(row for row in rows if row.startswith("| full"))
    assert full == "| full system | 2.0 / 1.0 | 3.0 / 1.5 | 4.0 / 2.0 | 3.0 |"
    without = next(row for row in rows if "without dsug" in row)
    assert without == "| without dsug | 4.0 / 2.0 | 4.0 / 2.0 | 4.0 / 2.0 | 4.0 (+1.0) |"
    assert next(row for row in rows if "without wls" in row).endswith("| - / - | - / - | - / - | - |")


def test_a_run_that_found_no_figure_leaves_a_dash(tmp_path: Path):
    for sequence in ablate.TABLES["dynamic"][1]:
        write(tmp_path, sequence, "", 0, None)
    many = len(ablate.TABLES["dynamic"][1])
    assert f"| full system | {'- / - | ' * many}- |" in ablate.table("dynamic", tmp_path, [0])


def test_only_parts_that_can_be_switched_off_are_listed():
    for name in ablate.TABLES:
        for part in ablate.parts_of(name):
            assert not part or set(part.split("+")) <= set(ABLATIONS)
    assert {"plucker", "dsug", "kalman", "wls"} <= set(ablate.parts_of("static"))


def test_what_is_there_is_not_run_again_and_most_is_most(tmp_path: Path, monkeypatch, capsys):
    ran = []
    monkeypatch.setattr(ablate, "prism_edge", lambda words: ran.append(words) or 0)
    shared = tmp_path / "shared"
    (shared / "models").mkdir(parents=True)
    (shared / ablate.NETWORK).write_text("")
    first = ablate.TABLES["static"][1][0]
    write(tmp_path / "out", first, "", 0, 0.02)
    words = ["--shared", str(shared), "--out", str(tmp_path / "out"), "--table", "static", "--seeds", "0"]
    assert ablate.main([*words, "--most", "2"]) == 1
    assert len(ran) == 2
    assert ran[0][:2] == ["eval", str(shared / first.folder)]
    assert "--lockstep" in ran[0]
    assert ran[0][ran[0].index("--ablate") + 1] == ablate.STATIC_PARTS[1]
    assert "full system | 2.0 / 1.0" in capsys.readouterr().out


def test_both_parts_of_a_pair_are_switched_off(tmp_path: Path, monkeypatch):
    ran = []
    monkeypatch.setattr(ablate, "prism_edge", lambda words: ran.append(words) or 0)
    sequence = ablate.TABLES["static"][1][1]
    ablate.play(tmp_path, tmp_path / "out", sequence, "dsug+consistency", 1)
    assert [ran[0][i + 1] for i, word in enumerate(ran[0]) if word == "--ablate"] == ["dsug", "consistency"]


def test_fewer_runs_than_none_are_refused(capsys):
    with pytest.raises(SystemExit) as ended:
        ablate.main(["--most", "-1"])
    assert ended.value.code == 2
    assert "whole number" in capsys.readouterr().err


@pytest.mark.parametrize(("most", "code"), [("1", 2), ("0", 1)])
def test_without_the_recordings_there_are_only_tables(tmp_path: Path, capsys, most, code):
    words = ["--shared", str(tmp_path), "--out", str(tmp_path / "out"), "--most", most]
    assert ablate.main(words) == code
    if code == 2:
        assert "is not there" in capsys.readouterr().err


def test_a_run_that_fails_is_named_in_one_line_and_the_others_go_on(tmp_path: Path, monkeypatch, capsys):
    ran = []
    monkeypatch.setattr(ablate, "prism_edge", lambda words: ran.append(words) or 7)
    (tmp_path / "models").mkdir()
    (tmp_path / ablate.NETWORK).write_text("")
    words = ["--shared", str(tmp_path), "--out", str(tmp_path / "out"), "--table", "static", "--most", "5"]
    assert ablate.main(words) == 8
    errors = capsys.readouterr().err.splitlines()
    assert len(ran) == len(errors) == 5
    assert all(line.startswith("ablate: error: ") and "ended with code 7" in line for line in errors)


def test_each_seed_is_another_delay_and_the_first_the_default(tmp_path: Path):
    sequence = ablate.TABLES["static"][1][0]
    lags = []
    for seed in range(len(ablate.LAGS)):
        config = metrics_of(ablate.command(tmp_path, tmp_path, sequence, "dsug", seed))["config"]
        assert config["seed"] == seed
        lags.append(config["lockstep"]["map_lag"])
    assert lags[0] == Config().lockstep.map_lag
    assert len(set(lags)) == len(lags)


def test_all_parts_come_with_one_seed_and_real_recordings_first():
    runs = ablate.missing(["static", "dynamic"], Path("nowhere"), Path("nowhere"), [0, 1])
    seeds = [seed for _, _, seed in runs]
    assert seeds == sorted(seeds)
    first = [sequence.distractors is None for sequence, _, seed in runs if seed == 0]
    assert first == sorted(first, reverse=True)
    assert {part for _, part, seed in runs if seed == 0} == set(ablate.STATIC_PARTS + ablate.DYNAMIC_PARTS)


def test_what_is_cut_short_is_compared_over_the_seeds_that_both_have(tmp_path: Path):
    for sequence in ablate.TABLES["static"][1]:
        for seed, metres in enumerate((0.02, 0.5, 0.9)):
            write(tmp_path, sequence, "", seed, metres)
        write(tmp_path, sequence, "dsug", 0, 0.03)
    rows = ablate.table("static", tmp_path, [0, 1, 2])
    assert "| full system | 50.0 / 25.0 | 50.0 / 25.0 | 50.0 / 25.0 | 50.0 |" in rows
    assert "| without dsug | 3.0 / 1.5 | 3.0 / 1.5 | 3.0 / 1.5 | 3.0 (+1.0) |" in rows
    assert rows.endswith("Medians of 1 to 3 seed(s).")


def test_a_run_that_was_cut_off_is_run_again(tmp_path: Path):
    sequence = ablate.TABLES["static"][1][0]
    write(tmp_path, sequence, "", 0, 0.02)
    before = len(ablate.missing(["static"], tmp_path.parent / "shared", tmp_path, [0]))
    (ablate.place(tmp_path, sequence, "", 0) / "metrics.json").write_text('{"live": {"ate')
    assert len(ablate.missing(["static"], tmp_path.parent / "shared", tmp_path, [0])) == before + 1
    assert "| full system | - / - " in ablate.table("static", tmp_path, [0])


def test_a_void_run_is_none(tmp_path: Path):
    sequence = ablate.TABLES["static"][1][0]
    write(tmp_path, sequence, "", 0, 0.02)
    before = len(ablate.missing(["static"], tmp_path.parent / "shared", tmp_path, [0]))
    file = ablate.place(tmp_path, sequence, "", 0) / "metrics.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "violations": ["a pose twice"]}))
    assert len(ablate.missing(["static"], tmp_path.parent / "shared", tmp_path, [0])) == before + 1
    assert "| full system | - / - " in ablate.table("static", tmp_path, [0])


def test_runs_that_would_be_made_otherwise_are_printed_counted_and_repeated(
    tmp_path: Path, monkeypatch, capsys
):
    out, shared = tmp_path / "out", tmp_path / "shared"
    (shared / "models").mkdir(parents=True)
    (shared / ablate.NETWORK).touch()
    for n, sequence in enumerate(ablate.TABLES["static"][1]):
        write(out, sequence, "", 0, 0.02)
        file = ablate.place(out, sequence, "", 0) / "metrics.json"
        made = json.loads(file.read_text())
        made["config"]["seed"] = 7
        if n:
            file.write_text(json.dumps(made))
    words = ["--shared", str(shared), "--out", str(out), "--table", "static", "--seeds", "0"]
    assert ablate.main([*words, "--most", "0"]) == 1
    said = capsys.readouterr().out
    assert "| full system | 2.0 / 1.0 | 2.0 / 1.0 | 2.0 / 1.0 | 2.0 |" in said
    assert said.endswith("2 of these 3 runs would be made otherwise now, by: seed (2).\n")
    ran = []
    monkeypatch.setattr(ablate, "prism_edge", lambda words: ran.append(words) or 0)
    ablate.main(words)
    full = [words[1] for words in ran if "--ablate" not in words]
    assert full == [str(shared / sequence.folder) for sequence in ablate.TABLES["static"][1][1:]]


def test_a_dynamic_recording_that_was_cut_off_is_made_anew(tmp_path: Path, monkeypatch):
    sequence = next(s for s in ablate.TABLES["dynamic"][1] if s.distractors is not None)
    made: list[Path] = []
    (tmp_path / "recordings" / sequence.name / "left").mkdir(parents=True)  # by an earlier build

    def make(words: list[str]) -> int:
        made.append(Path(words[1]))
        assert not made[-1].exists(), "make_distractors refuses a folder that is not empty"
        made[-1].mkdir(parents=True)
        (made[-1] / "image").touch()
        if len(made) == 1:
            raise KeyboardInterrupt
        (made[-1] / "distractors.json").touch()
        return 0

    monkeypatch.setattr(ablate.make_distractors, "main", make)
    with pytest.raises(KeyboardInterrupt):
        ablate.recording(tmp_path, tmp_path, sequence)
    folder = ablate.recording(tmp_path, tmp_path, sequence)
    assert sorted(path.name for path in folder.iterdir()) == ["distractors.json", "image"]
    assert ablate.recording(tmp_path, tmp_path, sequence) == folder
    assert len(made) == 2


def test_an_interrupt_ends_it(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(ablate, "prism_edge", lambda words: 130)
    (tmp_path / "models").mkdir()
    (tmp_path / ablate.NETWORK).write_text("")
    with pytest.raises(SystemExit) as ended:
        ablate.main(["--shared", str(tmp_path), "--out", str(tmp_path / "out"), "--table", "static"])
    assert ended.value.code == 130


def write_run(out: Path, sequence: ablate.Sequence, part: str, run: Trajectory, violations=()) -> None:
    write(out, sequence, part, 0, 0.02)
    folder = ablate.place(out, sequence, part, 0)
    made = json.loads((folder / "metrics.json").read_text())
    (folder / "metrics.json").write_text(json.dumps({**made, "violations": list(violations)}))
    write_tum(folder / "live.tum", run)


def test_errors_are_compared_where_both_runs_have_poses(tmp_path: Path):
    sequence = ablate.TABLES["dynamic"][1][0]
    truth = on_a_spiral(60)
    lost_later = on_a_spiral(60)
    lost_later.poses[40:, 0, 3] += np.linspace(0, 5, 20)  # where the other run has nothing to show
    early = truth.at(np.arange(40))
    early.poses[10:20, 2, 3] += 0.4
    for part, run in (("", lost_later), ("dsug", early)):
        write_run(tmp_path, sequence, part, run)
    found = ablate.on_common_frames(tmp_path, truth, sequence, "dsug", 0)
    assert found is not None
    assert found.frames == 40
    assert found.full == pytest.approx(0.0, abs=1e-3)
    assert 5.0 < found.without < 20.0
    assert ablate.on_common_frames(tmp_path, truth, sequence, "consistency", 0) is None


def test_only_frames_with_a_true_pose_are_counted_and_each_once(tmp_path: Path):
    sequence = ablate.TABLES["dynamic"][1][0]
    for part in ("", "dsug"):
        write_run(tmp_path, sequence, part, on_a_spiral(60))
    half = on_a_spiral(60).at(np.arange(30))
    found = ablate.on_common_frames(tmp_path, half, sequence, "dsug", 0)
    assert found is not None
    assert found.frames == 30
    near = (np.arange(30)[:, None] * 100 + [-4, 0, 4]).ravel() * 1_000_000  # three true poses for a frame
    dense = Trajectory(near.astype(np.int64), half.poses.repeat(3, axis=0))
    found = ablate.on_common_frames(tmp_path, dense, sequence, "dsug", 0)
    assert found is not None
    assert found.frames == 30


def test_a_void_run_is_compared_with_nothing(tmp_path: Path):
    sequence = ablate.TABLES["dynamic"][1][0]
    for part in ("", "dsug"):
        write_run(tmp_path, sequence, part, on_a_spiral(60), ["a pose twice"] if part else ())
    assert ablate.on_common_frames(tmp_path, on_a_spiral(60), sequence, "dsug", 0) is None


def test_runs_that_placed_no_frame_in_common_are_not_compared(tmp_path: Path):
    sequence = ablate.TABLES["dynamic"][1][0]
    truth = on_a_spiral(60)
    for part, rows in (("", np.arange(30)), ("dsug", np.arange(30, 60))):
        write_run(tmp_path, sequence, part, truth.at(rows))
    assert ablate.on_common_frames(tmp_path, truth, sequence, "dsug", 0) is None


def test_the_common_table_averages_what_all_sequences_have(tmp_path: Path, monkeypatch):
    sequences = ablate.TABLES["dynamic"][1]
    monkeypatch.setattr(ablate, "truth_of", lambda shared, sequence: on_a_spiral(60))
    for n, sequence in enumerate(sequences):
        for part in ("", "dsug"):
            run = on_a_spiral(60)
            run.poses[::2, 2, 3] += 0.02 * (n + 1) * (1 if part == "" else 2)
            write_run(tmp_path, sequence, part, run)
    rows = ablate.common_table("dynamic", tmp_path, tmp_path, 0).splitlines()
    without = next(row for row in rows if row.startswith("| without dsug |"))
    assert "2.0 / 1.0 (60)" in without
    assert without.endswith("9.0 / 4.5 (-50 %) |")
    assert next(row for row in rows if "consistency |" in row).endswith("| - |")


def test_a_run_that_lost_its_way_says_how_much_it_has(tmp_path: Path):
    sequence = ablate.TABLES["dynamic"][1][0]
    folder = ablate.place(tmp_path, sequence, "", 0)
    folder.mkdir(parents=True)
    live = {"ate_se3_m": 0.05, "ate_sim3_m": 0.02}
    (folder / "metrics.json").write_text(json.dumps({"live": live, "coverage": 0.762}))
    assert "| full system | 5.0 / 2.0 (76 %) |" in ablate.table("dynamic", tmp_path, [0])


def test_a_run_that_never_began_is_not_taken_for_the_one_before_it(tmp_path: Path, monkeypatch):
    sequence = ablate.TABLES["static"][1][0]
    write(tmp_path, sequence, "", 0, None)
    file = ablate.place(tmp_path, sequence, "", 0) / "metrics.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "unscored": "no pose"}))
    monkeypatch.setattr(ablate, "prism_edge", lambda words: 8)
    with pytest.raises(RuntimeError, match="code 8"):
        ablate.play(tmp_path.parent / "shared", tmp_path, sequence, "", 0)
