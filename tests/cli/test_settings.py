"""Which depth network runs where none, or none at all, is asked for."""

from __future__ import annotations

import argparse

import pytest

from prism_edge.cli.main import main
from prism_edge.cli.settings import (
    BUNDLED,
    add_common,
    add_input,
    config_from,
    find_networks,
    whole_from_one_to,
    whole_from_zero,
)
from prism_edge.config import Config, DepthConfig, NetworkConfig
from prism_edge.config_file import load
from prism_edge.errors import ModelError
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
    assert ("depth" in running, "scale" in running) == (not given, True)


def test_a_recording_is_played_again_where_that_is_asked_for() -> None:
    parser = argparse.ArgumentParser()
    add_input(parser)
    add_common(parser)
    for arguments, loops in ((["sim:room"], False), (["sim:room", "--loop"], True)):
        assert config_from(parser.parse_args(arguments)).source.loop == loops


def test_a_number_goes_up_to_the_most_and_no_further() -> None:
    taken = whole_from_one_to(12)
    assert [taken("1"), taken("12")] == [1, 12]
    for text in ("0", "13", "-1", "2.0"):
        with pytest.raises(argparse.ArgumentTypeError):
            taken(text)


def test_a_number_that_may_be_none_is_none_below() -> None:
    assert [whole_from_zero("0"), whole_from_zero("7")] == [0, 7]
    for text in ("-1", "", "1.5", "-0"):
        with pytest.raises(argparse.ArgumentTypeError):
            whole_from_zero(text)


def test_a_network_is_looked_for_where_it_is_to_run() -> None:
    depth = DepthConfig(model="/nowhere/missing.onnx")
    find_networks(Config(depth=depth, network=NetworkConfig(remote=("depth",))))
    with pytest.raises(ModelError, match="missing"):
        find_networks(Config(depth=depth))
