"""Ablations of recordings of one's own: which are run, with whose camera and truth."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from prism_edge.config import ABLATIONS
from prism_edge.evaluation.trajectory import write_tum
from tests.sources import tiny_datasets as tiny
from tests.sources.tiny_datasets import write_seven_scenes
from tests.tools.runs import metrics_of, on_a_spiral
from tools import ablate


@pytest.fixture
def own(monkeypatch) -> list[list[str]]:
    """What `eval` is given for recordings of one's own; without a part the error is 3 cm instead of 2."""
    monkeypatch.setattr(ablate, "TABLES", dict(ablate.TABLES))
    given: list[list[str]] = []

    def evaluate(words: list[str]) -> int:
        given.append(words)
        metres = 0.03 if "--ablate" in words else 0.02
        out = Path(words[words.index("--out") + 1])
        out.mkdir(parents=True)
        live = {"ate_se3_m": metres, "ate_sim3_m": metres / 2}
        made = {**metrics_of(words), "live": live, "coverage": 1.0}
        (out / "metrics.json").write_text(json.dumps(made))
        write_tum(out / "live.tum", on_a_spiral(20))
        return 0

    monkeypatch.setattr(ablate, "prism_edge", evaluate)
    return given


def test_recordings_of_ones_own_have_a_table(tmp_path: Path, own, capsys):
    folders = [tmp_path / "lab" / name for name in ("hall", "yard")]
    for folder in folders:
        write_seven_scenes(folder)
    words = [*map(str, folders), "--model", "mine.onnx", "--out", str(tmp_path / "out"), "--seeds", "0"]
    assert ablate.main([*words, "--most", "3"]) == 1
    assert len(own) == 3
    assert ablate.main(words) == 0
    assert len(own) == 2 * len(ablate.STATIC_PARTS)
    assert {words[1] for words in own} == set(map(str, folders))
    assert all(words[words.index("--model") + 1] == "mine.onnx" and "--lockstep" in words for words in own)
    parts = {words[words.index("--ablate") + 1] for words in own if "--ablate" in words}
    assert parts == set(ABLATIONS)
    said = capsys.readouterr().out
    heads = r"\S*lab_hall \| \S*lab_yard \| mean SE"
    assert re.search(rf"\| own recordings: live SE\(3\) / Sim\(3\), cm \| {heads}", said)
    assert "| full system | 2.0 / 1.0 | 2.0 / 1.0 | 2.0 |" in said
    assert "| without loop | 3.0 / 1.5 | 3.0 / 1.5 | 3.0 (+1.0) |" in said
    assert "redkitchen" not in said
    assert ablate.main(words) == 0
    assert len(own) == 2 * len(ablate.STATIC_PARTS), "what is there is not repeated"


def test_a_recording_that_is_not_there_fails_run_by_run(tmp_path: Path, own, monkeypatch, capsys):
    monkeypatch.setattr(ablate, "prism_edge", lambda words: 4)
    words = [str(tmp_path / "nowhere"), "--model", "mine.onnx", "--out", str(tmp_path / "out")]
    assert ablate.main([*words, "--seeds", "0", "--most", "2"]) == 8
    said = capsys.readouterr()
    assert said.err.count("eval ended with code 4") == 2
    assert "| full system | - / - | - |" in said.out
    assert f"ablate: warning: {tmp_path / 'nowhere'} has no truth" in said.err


def test_a_recording_that_is_damaged_is_not_said_to_have_no_truth(tmp_path: Path, own, monkeypatch, capsys):
    monkeypatch.setattr(ablate, "prism_edge", lambda words: 4)
    folder = tiny.write_tum(tmp_path / "hall")
    (folder / "groundtruth.txt").write_text("0.0 0 0 0 0 0 0 1\n")
    (folder / "rgb.txt").write_text("soon,rgb/0.png\n")
    words = [str(folder), "--model", "mine.onnx", "--out", str(tmp_path / "out"), "--seeds", "0"]
    assert ablate.main([*words, "--most", "1"]) == 8
    warning = capsys.readouterr().err.splitlines()[0]
    assert "no truth" not in warning
    assert "rgb.txt line 1" in warning


@pytest.mark.parametrize(
    "words", [["hall"], ["--model", "m.onnx"], ["hall", "--model", "m.onnx", "--table", "static"]]
)
def test_recordings_and_their_network_go_together(words: list[str], own, capsys):
    with pytest.raises(SystemExit) as ended:
        ablate.main(words)
    assert ended.value.code == 2
    assert "go together" in capsys.readouterr().err


def test_recordings_whose_names_end_alike_are_refused(tmp_path: Path, own, capsys):
    folders = [str(tmp_path / n / "a" / "b" / "c") for n in "xy"]
    with pytest.raises(SystemExit):
        ablate.main([*folders, "--model", "m.onnx"])
    assert "end alike" in capsys.readouterr().err
    assert not own


def test_each_recording_has_its_own_truth_and_all_one_camera(tmp_path: Path, own, capsys):
    folders = [write_seven_scenes(tmp_path / name) for name in ("hall", "yard")]
    for pose in folders[0].glob("*.pose.txt"):
        pose.unlink()
    truths = [tmp_path / "elsewhere" / f"{folder.name}.tum" for folder in folders]
    truths[0].parent.mkdir()
    for truth in truths:
        write_tum(truth, on_a_spiral(20))
    words = [*map(str, folders), "--model", "mine.onnx", "--seeds", "0", "--camera", "mine.yaml"]
    words += [word for truth in truths for word in ("--truth", str(truth))]
    words += ["--out", str(tmp_path / "out")]
    assert ablate.main(words) == 0
    given = {(run[1], run[run.index("--truth") + 1], run[run.index("--camera") + 1]) for run in own}
    assert given == {(str(f), str(t), "mine.yaml") for f, t in zip(folders, truths, strict=True)}
    said = capsys.readouterr()
    assert "has no truth" not in said.err
    assert "| without loop | 0.0 / 0.0 (20) | 0.0 / 0.0 (20) |" in said.out, "both runs are the truth's"
    assert ablate.main(words) == 0
    assert len(own) == 2 * len(ablate.STATIC_PARTS), "what is there is not repeated"


@pytest.mark.parametrize(
    ("more", "why"),
    [
        (["yard", "--truth", "hall.tum"], "once for each RECORDING"),
        (["--truth", "hall.tum", "--truth", "hall.tum"], "once for each RECORDING"),
        (["hall", "--truth", "hall.tum", "--truth", "yard.tum"], "end alike"),
        (["--truth", "nowhere.tum"], "nowhere.tum"),
        (["--truth", "empty.tum"], "empty.tum: holds no poses"),
    ],
)
def test_truths_that_belong_to_no_recording_are_refused(
    tmp_path: Path, own, monkeypatch, capsys, more: list[str], why: str
):
    monkeypatch.chdir(tmp_path)
    for name in ("hall.tum", "yard.tum"):
        write_tum(Path(name), on_a_spiral(20))
    Path("empty.tum").touch()
    with pytest.raises(SystemExit) as ended:
        ablate.main(["hall", *more, "--model", "m.onnx"])
    assert ended.value.code == 2
    assert why in capsys.readouterr().err
    assert not own


@pytest.mark.parametrize("words", [["--camera", "mine.yaml"], ["--truth", "mine.tum"]])
def test_the_tables_recordings_have_their_own_camera_and_truth(words: list[str], own, capsys):
    with pytest.raises(SystemExit) as ended:
        ablate.main(words)
    assert ended.value.code == 2
    assert "go with RECORDING" in capsys.readouterr().err


@pytest.mark.parametrize("void", [False, True])
def test_a_run_with_nothing_to_score_is_a_result_and_a_void_one_is_none(
    tmp_path: Path, own, monkeypatch, capsys, void: bool
):
    played = ablate.prism_edge

    def evaluate(words: list[str]) -> int:
        played(words)
        file = Path(words[words.index("--out") + 1]) / "metrics.json"
        made = json.loads(file.read_text())
        nothing = {"live": {"ate_se3_m": None}, "coverage": 0.0, "unscored": "no pose came out of 9 frames"}
        file.write_text(json.dumps({**made, **nothing, "violations": ["a pose twice"] * void}))
        return 8

    monkeypatch.setattr(ablate, "prism_edge", evaluate)
    folder = write_seven_scenes(tmp_path / "hall")
    words = [str(folder), "--model", "mine.onnx", "--out", str(tmp_path / "out"), "--seeds", "0"]
    assert ablate.main([*words, "--most", "1"]) == (8 if void else 1)
    said = capsys.readouterr()
    assert ("eval ended with code 8" in said.err) == void
    assert f"| full system | - / -{'' if void else ' (0 %)'} | - |" in said.out
    assert len(ablate.missing([ablate.OWN], tmp_path, tmp_path / "out", [0])) == len(
        ablate.STATIC_PARTS
    ) - (not void)
