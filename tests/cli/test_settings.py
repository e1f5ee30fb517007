"""Which depth network runs where none, or none at all, is asked for."""

from __future__ import annotations

import argparse

import pytest

from prism_edge.cli.main import main
from prism_edge.cli.settings import BUNDLED, add_common, add_input, config_from
from prism_edge.config_file import load
from prism_edge.processes import processes_for


def model(*arguments: str) -> str:
    parser = argparse.ArgumentParser()
    add_input(parser)
    add_common(parser)
    return config_from(parser.parse_args(arguments)).depth.model


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["sim:room"], BUNDLED),
        (["sim:loop?seed=3", "--set", "depth.model=fastdepth_nyu"], "fastdepth_nyu"),
        (["sim:room", "--model", "own.onnx"], "own.onnx"),
        (["sim:room", "--model", "none"], "none"),
        (["/somewhere/video.mp4"], ""),
        (["/somewhere/video.mp4", "--model", "none"], "none"),
        (["/somewhere/video.mp4", "--model", BUNDLED], BUNDLED),
        ([], ""),
    ],
)
def test_the_bundled_network_is_for_simulated_worlds_where_none_is_named(arguments, expected) -> None:
    assert model(*arguments) == expected


def test_a_configuration_file_counts_as_naming_one(tmp_path) -> None:
    (tmp_path / "own.yaml").write_text("depth: {model: none}\nsource: {uri: 'sim:room'}\n")
    assert model("--config", str(tmp_path / "own.yaml")) == "none"
    (tmp_path / "own.yaml").write_text("source: {uri: 'sim:room'}\n")
    assert model("--config", str(tmp_path / "own.yaml")) == BUNDLED


@pytest.mark.parametrize("given", [["--model", "none"], ["--set", "depth.model=none"], []])
def test_what_config_prints_reads_back_as_the_same_run(given, tmp_path, capsys) -> None:
    assert main(["config", "sim:room", *given]) == 0
    file = tmp_path / "effective.yaml"
    file.write_text(capsys.readouterr().out)
    named = "none" if given else BUNDLED
    assert model("--config", str(file)) == named
    assert load(file).depth.model == named  # what a worker is given
    running = {process.name for process in processes_for(load(file))}
    assert ("depth" in running, "scale" in running) == (not given, not given)
