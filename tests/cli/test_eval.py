"""`prism-edge eval` from the command line: help, refusals in one line, exit codes."""

from __future__ import annotations

from pathlib import Path

import pytest

from prism_edge.cli import demo
from prism_edge.cli.eval import effective
from prism_edge.cli.main import build_parser, main
from prism_edge.config import BusConfig
from prism_edge.config_file import load
from prism_edge.errors import FAILING_FILE, ConfigError, EvaluationError, ModelError, SourceError
from prism_edge.evaluation import run


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("prism-edge: error: ")
    assert captured.err.count("\n") == 1
    return captured.err


def test_help_names_every_option_of_the_contract(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["eval", "--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    for option in ("SEQUENCE", "--model", "--camera", "--lockstep", "--ablate", "--seed", "--truth", "--out"):
        assert option in shown
    assert "rtsp:" not in shown  # it has neither an end nor truth


def test_out_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["eval", "somewhere"])
    assert ended.value.code == 2
    assert "--out" in capsys.readouterr().err


def test_what_a_file_leaves_out_stays_out_beside_what_is_ablated(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("ablate: [kalman]\n")
    asked = ["eval", "sim:room", "--out", "x", "--config", str(tmp_path / "c.yaml")]
    for more in (["--ablate", "wls"], ["--ablate", "wls", "--ablate", "kalman"]):
        assert set(effective(build_parser("eval").parse_args([*asked, *more])).ablate) == {"kalman", "wls"}


@pytest.mark.parametrize(
    ("arguments", "words", "code"),
    [
        (["--ablate", "gravity"], "no such part", ConfigError.exit_code),
        (["--set", "source.frames=-1"], "source.frames", ConfigError.exit_code),
        (["--seed", "many"], "seed", ConfigError.exit_code),
        (["--config", "absent.yaml"], "absent.yaml", ConfigError.exit_code),
        (["--set", "tracking.feature=7"], "tracking.feature", ConfigError.exit_code),
        ([], "empty or of no known kind", SourceError.exit_code),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], words: str, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", str(tmp_path), "--out", str(tmp_path / "out"), *arguments]) == code
    assert words in one_line(capsys)


@pytest.mark.parametrize("address", ["v4l2:/dev/video0", "rtsp://10.0.0.9/a", "oak:"])
def test_a_live_camera_is_refused_before_its_camera_file_is_asked_for(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", address, "--out", str(tmp_path)]) == EvaluationError.exit_code
    assert "a live camera has neither an end nor truth" in one_line(capsys)


@pytest.mark.parametrize("command", ["eval", "demo"])
def test_help_says_that_a_free_port_is_taken(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    shown = " ".join(capsys.readouterr().out.split())
    assert "(default: a free port of loopback" in shown
    assert BusConfig().endpoint not in shown


def test_a_missing_sequence_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", str(tmp_path / "none"), "--out", str(tmp_path)]) == SourceError.exit_code
    assert "does not exist" in one_line(capsys)


@pytest.mark.parametrize(("name", "said"), [("no.tum", "no.tum: no such file"), ("", ": a folder")])
def test_a_truth_that_is_none_is_found_before_the_run(
    name: str, said: str, tiny_sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(["eval", str(tiny_sequence), "--out", str(tmp_path / "o"), "--truth", str(tmp_path / name)])
    assert code == EvaluationError.exit_code
    assert said in one_line(capsys)


def test_only_the_first_frames_may_be_played(tiny_sequence: Path) -> None:
    words = ["eval", str(tiny_sequence), "--out", "nowhere"]
    for more, frames in (([], 0), (["--frames", "7"], 7), (["--set", "source.frames=5"], 5)):
        args = build_parser("eval").parse_args([*words, *more])
        assert effective(args).source.frames == frames


def test_frames_are_a_whole_number(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["eval", "somewhere", "--out", "nowhere", "--frames", "0"])
    assert ended.value.code == 2
    assert "whole number above 0" in capsys.readouterr().err


def test_a_robot_name_that_is_no_key_is_refused(
    tiny_sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(["eval", str(tiny_sequence), "--out", str(tmp_path / "o"), "--robot", "a/*"])
    assert code == ConfigError.exit_code
    assert "robot" in one_line(capsys)


def test_results_that_cannot_be_written_are_one_line(
    tiny_sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    code = main(["eval", str(tiny_sequence), "--out", str(tmp_path / "file" / "o")])
    assert code == FAILING_FILE
    assert "can't write" in one_line(capsys)


@pytest.mark.parametrize("command", ["eval", "demo"])
@pytest.mark.parametrize("model", ["nope", "nested:prism_nano,/nowhere/net.onnx"])
def test_a_network_that_is_not_there_leaves_earlier_results(
    command: str, model: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "metrics.json").write_text("{}")
    words = [command, "sim:room?frames=9", "--model", model, "--out", str(tmp_path)]
    assert main(words) == ModelError.exit_code
    assert model.rpartition(",")[2] in one_line(capsys)
    assert [file.name for file in tmp_path.iterdir()] == ["metrics.json"]


DEFAULT = BusConfig().endpoint


@pytest.mark.parametrize("command", ["eval", "demo"])
@pytest.mark.parametrize(
    ("given", "kept"),
    [
        (["--endpoint", DEFAULT], True),
        (["--set", f"bus.endpoint={DEFAULT}"], True),
        (["--endpoint", "tcp/127.0.0.1:7999"], True),
        ([], False),
    ],
)
def test_an_endpoint_that_is_given_is_kept_be_it_the_default(
    command: str, given: list[str], kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise EvaluationError("far enough")

    monkeypatch.setattr(run, "_run", refused)
    monkeypatch.setattr(demo, "show", lambda config, over: None)
    out = tmp_path / "out"
    assert main([command, "sim:room?frames=9", "--out", str(out), *given]) == EvaluationError.exit_code
    endpoint = load(out / "effective.yaml").bus.endpoint
    assert (endpoint == (given[-1].rpartition("=")[2] if given else DEFAULT)) is kept
