"""From what a user writes after --model to a network, or to one line that helps."""

from __future__ import annotations

from pathlib import Path

import pytest

from prism_edge.config import DepthConfig
from prism_edge.depth import open_network, pinned_files
from prism_edge.depth.registry import find
from prism_edge.errors import ModelError
from tests.synthetic.network import TinyNetwork, write_tiny_network

CONFIG = DepthConfig()


def test_a_path_opens_the_network(tmp_path: Path):
    path = write_tiny_network(tmp_path / "tiny.onnx")
    network = open_network(str(path), CONFIG)
    assert network.name == "tiny_tint"
    assert network.provider == "CPUExecutionProvider"


def test_nested_opens_both(tmp_path: Path):
    relative = write_tiny_network(tmp_path / "r.onnx", TinyNetwork(name="r", depth_kind="relative"))
    metric = write_tiny_network(tmp_path / "m.onnx", TinyNetwork(name="m"))
    assert open_network(f"nested:{relative}, {metric}", CONFIG).name == "nested:r,m"


@pytest.mark.parametrize("kind", ["relative", "inverse_relative"])
def test_a_relative_network_alone_is_refused_and_told_how_to_pair(tmp_path: Path, kind: str):
    path = write_tiny_network(tmp_path / "r.onnx", TinyNetwork(name="r", depth_kind=kind))
    with pytest.raises(ModelError, match="has no metres; pair it") as error:
        open_network(str(path), CONFIG)
    assert f"--model nested:{path},METRIC" in str(error.value)
    assert error.value.exit_code == 5


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        ("no_such_name", "neither a file nor a registered name"),
        ("no/such/file.onnx", "no such file"),
        ("file.onnx", "no such file"),
        ("da3_small", "must be exported|to be exported"),
        (".", "is a folder"),
        ("", "the name is empty"),
        ("nested:", "takes two networks"),
        ("nested:a", "takes two networks"),
        ("nested:a,b,c", "takes two networks"),
        ("nested:a,", "takes two networks"),
        ("nested:a,b", "'a' is neither"),
        ("bad\x00name", "neither|no such"),
        ("x" * 300 + ".onnx", r"can't be read \(File name too long\)"),
    ],
)
def test_what_can_not_be_opened_is_one_line(spec: str, says: str):
    with pytest.raises(ModelError, match=says) as error:
        open_network(spec, CONFIG)
    assert "\n" not in str(error.value)


def test_a_registered_name_without_its_file_says_where_it_was_sought(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("PRISM_EDGE_MODELS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with pytest.raises(ModelError, match=r"put it there or give its path \(docs/MODELS.md\)") as error:
        open_network("fastdepth_nyu", CONFIG)
    assert str(tmp_path) in str(error.value)


def test_of_a_name_that_nobody_knows_no_files_are_asked_for():
    assert pinned_files("no_such_name") == ()
    assert pinned_files("da3_small") == (), "nor of a checkpoint, which is none of a network's files"
    assert [f.sha256[:12] for f in pinned_files("fastdepth_nyu")] == ["6275c23f467d"]


def test_a_registered_name_opens_only_the_registered_file(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("PRISM_EDGE_MODELS", str(tmp_path))
    write_tiny_network(tmp_path / find("fastdepth_nyu").file)
    with pytest.raises(ModelError, match="not the registered 6275c23f467d"):
        open_network("fastdepth_nyu", CONFIG)


@pytest.mark.realdata
def test_the_real_networks_open_by_name_and_by_path(shared: Path, monkeypatch):
    monkeypatch.setenv("PRISM_EDGE_MODELS", str(shared / "models"))
    assert open_network("fastdepth_nyu", CONFIG).bias_sigma == 0.10
    assert open_network(str(shared / "models" / find("fastdepth_nyu").file), CONFIG).name == "fastdepth_nyu"
    with pytest.raises(ModelError, match="inverse relative depth"):
        open_network("depth_anything_v2_small", CONFIG)
