"""The demo: what it refuses and what it sums up. tests/test_packaging.py runs it from end to end."""

from __future__ import annotations

import pytest

from prism_edge.cli import demo
from prism_edge.cli.demo import sum_up
from prism_edge.cli.main import main
from prism_edge.evaluation.trajectory import Trajectory, write_tum
from prism_edge.sources.truth import read_truth

REPORT = {
    "tracked": 99,
    "frames": 100,
    "dropped_frames": 1,
    "coverage": 0.99,
    "fps": 29.97,
    "live": {"ate_se3_m": 0.0512, "ate_sim3_m": 0.0204, "scale_ratio": 1.0 / 0.96},
    "latency_ms": {"p50": 11.04, "p99": None},
    "cpu_ms_per_frame": {"total": 40.0},
    "ready_s": 1.25,
    "timings_void": False,
}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["/somewhere/else"], "the demo plays simulated worlds"),
        (["rtsp://me:secret@camera/live"], "rtsp://camera/live: the demo plays simulated worlds"),
        (["sim:moon"], "no simulated world is called 'moon'"),
        (["sim:room?seed=x"], "seed must be a whole number"),
    ],
)
def test_what_it_can_not_play_is_said_in_one_line(arguments, words, tmp_path, capsys) -> None:
    assert main(["demo", *arguments, "--out", str(tmp_path / "out")]) == 4
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1
    assert "secret" not in said.err
    assert not (tmp_path / "out").exists()


def test_an_unknown_network_is_said_in_one_line(tmp_path, capsys) -> None:
    assert main(["demo", "--model", "no_such_network", "--out", str(tmp_path / "out")]) == 5
    assert "no_such_network" in capsys.readouterr().err


def test_without_a_network_there_is_nothing_to_see(tmp_path, capsys) -> None:
    for given in (["--model", "none"], ["--set", "depth.model=none"]):
        assert main(["demo", *given, "--out", str(tmp_path / "out")]) == 3
        assert "needs a depth network" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_options_that_no_simulated_world_takes_are_not_offered(capsys) -> None:
    with pytest.raises(SystemExit):
        main(["demo", "--help"])
    shown = capsys.readouterr().out
    assert "--camera" not in shown
    assert "none" not in shown.replace("\n", " ").lower()
    with pytest.raises(SystemExit) as ended:
        main(["demo", "--camera", "camera.yaml"])
    assert ended.value.code == 2


def test_the_summary_gives_errors_scale_rate_and_latency(tmp_path, capsys) -> None:
    sum_up(REPORT, tmp_path, tmp_path / "path.png", 2.56)
    said = capsys.readouterr().out
    for words in ("99 of 100 frames, 1 dropped", "0.990", "30.0 Hz", "11.0, - ms", "0.0512 m", "0.0204 m"):
        assert words in said
    assert "SE(3) (2.0 % of the path's extent, 2.56 m)" in said
    assert "4.0 %" in said  # published metres are 4 % too short
    assert "say little" not in said
    sum_up({**REPORT, "timings_void": True}, tmp_path, None, 0.0)
    assert "say little" in capsys.readouterr().out


def test_a_picture_that_can_not_be_written_is_one_line(tmp_path, capsys, monkeypatch) -> None:
    """In place of a full disk: a folder of its name."""

    def played(config, out):
        (out / "path.png").mkdir(parents=True)
        write_tum(out / "live.tum", Trajectory(*read_truth(config.source.uri)))
        return REPORT

    monkeypatch.setattr(demo, "play", played)
    assert main(["demo", "--out", str(tmp_path / "out")]) == 74
    said = capsys.readouterr()
    assert said.err == f"prism-edge: error: {tmp_path / 'out' / 'path.png'}: Is a directory\n"
    assert "picture" not in said.out
