"""`prism-edge models`: names, licences, states, and one line for what can't be described."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper

from prism_edge.cli import models_show
from prism_edge.cli.main import main
from prism_edge.cli.models_trial import _above_zero
from prism_edge.depth import entries, find
from prism_edge.depth.contract import INVERSE_RELATIVE, RELATIVE
from prism_edge.depth.prediction import Prediction
from prism_edge.depth.registry import File
from prism_edge.depth.session import OnnxNetwork
from tests.synthetic.network import TinyNetwork, save, tiny_graph, write_sidecar, write_tiny_network


@pytest.fixture(autouse=True)
def plain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A wide terminal, and no network files but those of the test."""
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setenv("PRISM_EDGE_MODELS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)


def test_list_names_every_network_with_licence_and_state(tmp_path: Path, capsys):
    write_tiny_network(tmp_path / find("fastdepth_nyu").file)  # not the file it should be
    assert main(["models", "list"]) == 0
    out = capsys.readouterr().out
    rows = {line.split("│")[1].strip(): line for line in out.splitlines() if line.startswith("│")}
    for entry in entries():
        assert entry.licence in rows[entry.name]
    assert "wrong digest" in rows["fastdepth_nyu"]
    assert "no file here" in rows["depth_anything_v2_small"]
    assert "needs export" in rows["da3_small"]


def test_a_narrow_terminal_cuts_no_name(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["models", "list"]) == 0
    out = capsys.readouterr().out
    assert all(entry.name in out and entry.licence in out for entry in entries())


def test_info_checks_a_file_and_shows_its_card(tmp_path: Path, capsys):
    path = write_tiny_network(tmp_path / "tiny.onnx", TinyNetwork(depth_kind="inverse_relative"))
    assert main(["models", "info", str(path)]) == 0
    out = capsys.readouterr().out
    for text in ("tiny_tint", "inverse_relative", "CPUExecutionProvider", str(path), "nested:THIS,METRIC"):
        assert text in out


def test_info_says_where_the_card_is_from(tmp_path: Path, capsys):
    path = write_tiny_network(tmp_path / "tiny.onnx")
    assert main(["models", "info", str(path)]) == 0
    assert "card      the file itself" in capsys.readouterr().out
    write_sidecar(path, TinyNetwork(name="corrected").card())
    (tmp_path / "current.onnx").symlink_to(path)
    assert main(["models", "info", str(tmp_path / "current.onnx")]) == 0
    assert f"card      {path}.yaml" in capsys.readouterr().out


def test_info_says_how_far_a_test_picture_is_and_doubts_millimetres(tmp_path: Path, capsys):
    for name, gain, doubted in (("m", 1.0, False), ("mm", 1000.0, True)):
        path = write_tiny_network(tmp_path / f"{name}.onnx", TinyNetwork(name=name, gain=gain))
        assert main(["models", "info", str(path)]) == 0
        out = capsys.readouterr().out
        assert "depth     of a test picture: " in out
        assert ("warning   a median depth of" in out) == doubted


def test_info_of_a_network_whose_answer_is_of_no_use_fails_as_verify_does(tmp_path: Path, capsys):
    path = write_tiny_network(tmp_path / "bad.onnx", TinyNetwork(misbehaviour="negative"))
    for action in ("info", "verify"):
        assert main(["models", action, str(path)]) == 5
        assert "of no use" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("kind", ["metric", "relative"])
def test_a_network_that_fails_at_a_picture_is_one_line(tmp_path: Path, monkeypatch, capsys, kind: str):
    good = write_tiny_network(tmp_path / "good.onnx")
    bad = write_tiny_network(tmp_path / "bad.onnx", TinyNetwork(name="bad", depth_kind=kind))
    raw, warmed = OnnxNetwork.raw, []

    def fails(network, rgb):
        if network.name == "bad" and warmed.count(network) == 1:  # not at the first, which is no picture
            raise RuntimeError("indices out of bounds")
        warmed.append(network)
        return raw(network, rgb)

    monkeypatch.setattr(OnnxNetwork, "raw", fails)
    assert main(["models", "info", str(bad)]) == 5
    assert "bad: an inference failed (indices out of bounds)" in capsys.readouterr().err
    assert main(["models", "verify", str(bad), str(good)]) == 5
    out = " ".join(capsys.readouterr().out.split())
    assert "an inference failed" in out
    assert "on CPUExecutionProvider" in out


def test_info_shows_what_black_and_white_are_to_the_network(tmp_path: Path, capsys):
    path = write_tiny_network(tmp_path / "tiny.onnx")
    assert main(["models", "info", str(path)]) == 0
    assert "input     of black to white: 0 to 1\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("matrix", "says"),
    [
        ([160.0, 0, 159.5, 0, 160.0, 119.5, 0, 0, 1], ""),
        ([0.7, 0, 0.5, 0, 0.9, 0.5, 0, 0, 1], "sees a camera that can't be (fx: "),
        ([0.0] * 9, "it sees no camera"),
    ],
)
def test_info_doubts_intrinsics_of_another_unit(tmp_path: Path, capsys, matrix: list[float], says: str):
    what, path = TinyNetwork(), tmp_path / "net.onnx"
    graph = tiny_graph(what)
    value = helper.make_tensor("matrix", TensorProto.FLOAT, [1, 3, 3], matrix)
    graph.node.append(helper.make_node("Constant", [], ["camera"], value=value))
    graph.output.append(helper.make_tensor_value_info("camera", TensorProto.FLOAT, [1, 3, 3]))
    save(path, graph, replace(what.card(), intrinsics_output="camera"))
    assert main(["models", "info", str(path)]) == 0
    out = capsys.readouterr().out
    assert says in out
    assert ("warning" in out) == bool(says)


def test_info_shows_the_card_of_each_part_of_a_pair(tmp_path: Path, capsys):
    relative = write_tiny_network(tmp_path / "r.onnx", TinyNetwork(name="fine", depth_kind="relative"))
    metric = write_tiny_network(tmp_path / "m.onnx", TinyNetwork(name="coarse"))
    pair = f"nested:{relative},{metric}"
    assert main(["models", "info", pair]) == 0
    out = capsys.readouterr().out
    for text in ("fine: the file agrees", "coarse: the file agrees", f"use it with --model {pair}"):
        assert text in out
    assert main(["models", "info", f"nested:{metric},{relative}"]) == 5
    assert "the first network must be a relative one" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "says"), [("fastdepth_nyu", "229.7"), ("da3_small", "must be exported")])
def test_info_describes_a_network_whose_file_is_not_here(capsys, name: str, says: str):
    assert main(["models", "info", name]) == 0
    assert says in capsys.readouterr().out


def test_info_says_how_a_file_that_can_t_be_pulled_is_used(capsys):
    assert main(["models", "info", "depth_anything_v2_small"]) == 0
    out = capsys.readouterr().out
    assert "models pull" not in out
    assert "nested:THIS,METRIC" in out


def test_a_network_is_ready_only_with_the_external_data_that_is_its_own(tmp_path: Path):
    files = []
    for name in ("net.onnx", "net.onnx.data"):
        (tmp_path / name).write_bytes(name.encode())
        files.append(File(name, hashlib.sha256(name.encode()).hexdigest()))
    entry = replace(find("fastdepth_nyu"), name="net", files=tuple(files))
    assert models_show.state(entry) == "ready"
    (tmp_path / "net.onnx.data").write_bytes(b"others")
    assert models_show.state(entry) == "wrong digest"


@pytest.mark.realdata
def test_a_registered_network_is_ready_where_its_file_is(shared: Path, monkeypatch, capsys):
    monkeypatch.setenv("PRISM_EDGE_MODELS", str(shared / "models"))
    assert main(["models", "list"]) == 0
    assert "ready" in next(line for line in capsys.readouterr().out.splitlines() if "fastdepth_nyu" in line)
    assert main(["models", "info", "fastdepth_nyu"]) == 0


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        *((["info", name], 5) for name in ("nothing", "none/such.onnx", "")),
        *((words, 2) for words in ([], ["info"], ["shout"])),
    ],
)
def test_what_can_not_be_done_is_one_line_and_a_code(capsys, arguments: list[str], code: int):
    try:
        result = main(["models", *arguments])
    except SystemExit as error:  # argparse's own way out
        result = error.code
    assert result == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "Traceback" not in captured.err
    if code == 5:
        assert captured.err.count("\n") == 1


def test_what_others_have_written_is_shown_as_it_is(tmp_path: Path, capsys):
    """Rich reads [words] as styles, and fails where one ends that has not begun."""
    folder = tmp_path / "[old]"
    folder.mkdir()
    what = TinyNetwork()
    path = folder / "tiny.onnx"
    save(path, tiny_graph(what), replace(what.card(), source="seen [/x] at a fair"))
    for words in (["info", str(path)], ["verify", str(path)]):
        assert main(["models", *words]) == 0
        assert "[old]" in "".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("said", "relative", "inverse"),
    [
        ([-3, -1, 2], [0, 2, 5], [0, 2, 5]),
        ([1, 2, 3], [1, 2, 3], [0, 1, 2]),  # of inverse depth none is known to be the farthest
        ([-1, 0, 3], [0, 0, 4], [0, 1, 4]),  # no relative depth, but any inverse depth
        ([np.nan, np.nan, np.nan],) * 3,
    ],
)
def test_depth_known_up_to_a_shift_is_tried_without_what_lies_below_zero(
    said: list[float], relative: list[float], inverse: list[float]
):
    none = np.zeros((0, 0), np.float32)
    depth = np.array([said], np.float32)
    raw = Prediction(depth, np.array([1.0, 0.0, 1.0, 0.0]), none, np.zeros(0, np.float32), 0.0)
    for kind, wanted in ((RELATIVE, relative), (INVERSE_RELATIVE, inverse)):
        np.testing.assert_array_equal(_above_zero(raw, kind).depth, [wanted])
