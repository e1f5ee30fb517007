"""The table of what loops are worth."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from prism_edge.evaluation.trajectory import NS, Trajectory, write_tum
from tools import measure_loops


def walk(frames: int, bend: float = 0.0) -> Trajectory:
    """A quarter of a metre a frame; the last third bends away by so much a frame."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = 0.25 * np.arange(frames)
    poses[:, 1, 3] = bend * np.maximum(np.arange(frames) - 2 * frames // 3, 0)
    return Trajectory(NS // 30 * np.arange(frames), poses)


def leave(out: Path, found: Trajectory, accepted: int = 0, precision: float | None = None) -> None:
    """What a run of `eval` leaves, as far as the table asks for it; the truth is straight."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "metrics.json").write_text(json.dumps({"loops": {"accepted": accepted, "precision": precision}}))
    write_tum(out / "final.tum", found)
    write_tum(out / "truth.tum", walk(60))


def test_each_sequence_runs_twice_and_gives_a_line(tmp_path, monkeypatch, capsys):
    ran = []

    def evaluate(words: list[str]) -> int:
        ran.append(words)
        out = Path(words[words.index("--out") + 1])
        out.mkdir(parents=True)
        leave(out, walk(60, 0.1)) if "--ablate" in words else leave(out, walk(60, 1e-3), 5, 1.0)
        return 0

    monkeypatch.setattr(measure_loops, "prism_edge", evaluate)
    words = ["measure_loops", "sim:loop", "some/folder", "--model", "m.onnx", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", words)
    measure_loops.main()
    assert [("--ablate" in words, words[1]) for words in ran] == [
        (False, "sim:loop"),
        (True, "sim:loop"),
        (False, "some/folder"),
        (True, "some/folder"),
    ]
    assert all("--lockstep" in words for words in ran)
    lines = capsys.readouterr().out.splitlines()
    cells = (
        r"\| sim:loop \| 5 \| 100 % \| [1-9]\d\.\d\d cm \| 0\.\d\d cm \| (9\d|100) % \| 60, 60, 60 \|"
    )
    assert re.fullmatch(cells, lines[2])
    assert len(lines) == 4


def test_where_no_loop_was_accepted_it_runs_once(tmp_path, monkeypatch, capsys):
    ran = []

    def evaluate(words: list[str]) -> int:
        ran.append(words)
        leave(Path(words[words.index("--out") + 1]), walk(60, 0.1))
        return 0

    monkeypatch.setattr(measure_loops, "prism_edge", evaluate)
    monkeypatch.setattr(sys, "argv", ["measure_loops", "a", "--model", "m.onnx", "--out", str(tmp_path)])
    measure_loops.main()
    assert len(ran) == 1
    cells = capsys.readouterr().out.splitlines()[2].split(" | ")
    assert cells[:3] == ["| a", "0", "-"]
    assert cells[3] == cells[4]
    assert cells[5:] == ["0 %", "60, 60, 60 |"]


def test_what_could_not_be_computed_is_a_dash(tmp_path):
    leave(tmp_path / "with", Trajectory.of([]))
    leave(tmp_path / "without", walk(60))
    folders = tmp_path / "with", tmp_path / "without"
    line = measure_loops.row("x", {"accepted": 0, "precision": None}, folders)
    assert line == "| x | 0 | - | - | - | - | 0, 60, 0 |"


def test_frames_that_only_a_loop_has_placed_count_for_neither(tmp_path):
    leave(tmp_path / "with", walk(60, 0.5))
    leave(tmp_path / "without", walk(60, 0.5).at(np.arange(40)))
    (after, before), frames = measure_loops.on_common_frames((tmp_path / "with", tmp_path / "without"))
    assert after == before == pytest.approx(0.0, abs=1e-6)
    assert frames == "40, 40, 60"


def test_a_run_that_fails_ends_it_with_its_code(tmp_path, monkeypatch):
    monkeypatch.setattr(measure_loops, "prism_edge", lambda words: 4)
    with pytest.raises(SystemExit) as ended:
        measure_loops.run("nothing", "m.onnx", tmp_path, True)
    assert ended.value.code == 4
