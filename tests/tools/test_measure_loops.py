"""The table of what loops are worth."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from tools import measure_loops


def metrics(error: float | None, accepted: int = 0, precision: float | None = None) -> dict:
    return {"final": {"ate_sim3_m": error}, "loops": {"accepted": accepted, "precision": precision}}


def test_each_sequence_runs_twice_and_gives_a_line(tmp_path, monkeypatch, capsys):
    ran = []

    def evaluate(words: list[str]) -> int:
        ran.append(words)
        out = Path(words[words.index("--out") + 1])
        out.mkdir(parents=True)
        found = metrics(0.9) if "--ablate" in words else metrics(0.05, 5, 1.0)
        (out / "metrics.json").write_text(json.dumps(found))
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
    assert lines[2] == "| sim:loop | 5 | 100 % | 90.00 cm | 5.00 cm | 94 % |"
    assert len(lines) == 4


def test_where_no_loop_was_accepted_it_runs_once(tmp_path, monkeypatch, capsys):
    ran = []

    def evaluate(words: list[str]) -> int:
        ran.append(words)
        out = Path(words[words.index("--out") + 1])
        out.mkdir(parents=True)
        (out / "metrics.json").write_text(json.dumps(metrics(0.05)))
        return 0

    monkeypatch.setattr(measure_loops, "prism_edge", evaluate)
    monkeypatch.setattr(sys, "argv", ["measure_loops", "a", "--model", "m.onnx", "--out", str(tmp_path)])
    measure_loops.main()
    assert len(ran) == 1
    assert capsys.readouterr().out.splitlines()[2] == "| a | 0 | - | 5.00 cm | 5.00 cm | 0 % |"


def test_what_could_not_be_computed_is_a_dash():
    assert measure_loops.row("x", metrics(None), metrics(0.1)) == "| x | 0 | - | 10.00 cm | - | - |"


def test_a_run_that_fails_ends_it_with_its_code(tmp_path, monkeypatch):
    monkeypatch.setattr(measure_loops, "prism_edge", lambda words: 4)
    with pytest.raises(SystemExit) as ended:
        measure_loops.run("nothing", "m.onnx", tmp_path, True)
    assert ended.value.code == 4
