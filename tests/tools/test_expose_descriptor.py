"""The tool that gives a network a descriptor output, on real networks and images where they are at hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from prism_edge.depth.contract import card_from_metadata
from prism_edge.depth.inner_tensor import POOLINGS, pool
from prism_edge.depth.session import OnnxNetwork
from prism_edge.errors import ModelError
from tests.synthetic.network import TinyNetwork, save, tiny_graph, write_tiny_network
from tools import expose_descriptor, measure_places

# One of opset 7, whose initialisers are inputs, and one quantised transformer.
NETWORKS = ["fastdepth_nyu_224.onnx", "depth_anything_v2_small_252x336_int8.onnx"]
REVISITS = (280, 990, 170, 650)  # frames of redkitchen: two of one place, two of another


def _session(path: Path) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.log_severity_level, options.intra_op_num_threads = 4, 1
    return onnxruntime.InferenceSession(str(path), options)


@pytest.mark.realdata
@pytest.mark.parametrize("file", NETWORKS)
def test_real_networks_keep_their_depth_and_know_places_again(shared, redkitchen, tmp_path, file):
    out = tmp_path / "places.onnx"
    assert expose_descriptor.main([str(shared / "models" / file), str(out)]) == 0
    network = OnnxNetwork(out)
    assert network.card.descriptor_output == expose_descriptor.OUTPUT
    plain = OnnxNetwork(shared / "models" / file)
    poses = [np.loadtxt(redkitchen / f"frame-{index:06d}.pose.txt") for index in REVISITS]
    assert max(_apart(*poses[:2]), _apart(*poses[2:])) < 0.45 < 0.9 < _apart(poses[0], poses[2])
    descriptors = []
    for index in REVISITS:
        image = cv2.imread(str(redkitchen / f"frame-{index:06d}.color.jpg"))[:, :, ::-1]
        image = np.ascontiguousarray(image)
        answer, expected = network.raw(image)[0], plain.raw(image)[0]
        assert np.array_equal(answer.depth, expected.depth)
        assert np.linalg.norm(answer.descriptor) == pytest.approx(1.0, abs=1e-5)
        assert answer.descriptor == pytest.approx(expected.descriptor, abs=1e-4)  # what the daemon pools
        descriptors.append(answer.descriptor)
    alike = np.array(descriptors) @ np.array(descriptors).T
    assert min(alike[0, 1], alike[2, 3]) > alike[:2, 2:].max()


def _apart(first: np.ndarray, second: np.ndarray) -> float:
    """Metres between two poses, a radian counted as one metre."""
    turn = np.arccos(np.clip((np.trace(first[:3, :3].T @ second[:3, :3]) - 1) / 2, -1, 1))
    return float(np.linalg.norm(first[:3, 3] - second[:3, 3]) + turn)


@pytest.mark.parametrize("pooling", POOLINGS)
@pytest.mark.parametrize("opset", [9, 13, 20])
def test_the_graph_computes_what_the_daemon_computes(tmp_path, pooling, opset):
    tokens = pooling == "token"
    shape = (1, 6, 4) if tokens else (1, 4, 5, 7)
    value = helper.make_tensor_value_info
    nodes = [*expose_descriptor.pooling_nodes("x", shape, pooling, opset)]
    output = value(expose_descriptor.OUTPUT, TensorProto.FLOAT, None)
    graph = helper.make_graph(nodes, "g", [value("x", TensorProto.FLOAT, shape)], [output])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    path = tmp_path / "pool.onnx"
    onnx.save(model, str(path))
    values = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    (got,) = _session(path).run(None, {"x": values})
    assert got.shape[0] == 1
    assert got[0] == pytest.approx(pool(values, pooling), abs=1e-5)


def test_a_layer_is_chosen_in_the_encoder_and_written_in_the_card(tmp_path, capsys):
    path, out = write_tiny_network(tmp_path / "tiny.onnx"), tmp_path / "out.onnx"
    assert expose_descriptor.main([str(path), str(out)]) == 0
    props = {prop.key: prop.value for prop in onnx.load(str(out)).metadata_props}
    card = card_from_metadata(props, "out")
    assert (card.name, card.descriptor_output) == ("tiny_tint_places", expose_descriptor.OUTPUT)
    assert card.descriptor_layer in expose_descriptor.poolable(onnx.load(str(path)))
    assert "bit for bit" in capsys.readouterr().out


@pytest.mark.parametrize("named", [True, False])
def test_an_input_of_free_size_is_of_its_cards(tmp_path, capsys, named):
    what = TinyNetwork()
    graph = tiny_graph(what)
    for value in (*graph.input, *graph.output):
        for dim in value.type.tensor_type.shape.dim:
            dim.dim_param = "free"
    graph.input[0].type.tensor_type.shape.dim[1].dim_value = 3
    path, out = tmp_path / "free.onnx", tmp_path / "out.onnx"
    save(path, graph, replace(what.card(), input_name="image" if named else ""))
    assert expose_descriptor.main([str(path), "--list"]) == 0
    assert "small  [1, 3, 60, 80]" in capsys.readouterr().out
    assert expose_descriptor.main([str(path), str(out), "--layer", "small", "--pooling", "grid"]) == 0
    assert OnnxNetwork(out).raw(np.full((48, 64, 3), 90, np.uint8))[0].descriptor.size == 12


@pytest.mark.parametrize("by", ["card", "option"])
def test_an_output_of_the_graph_is_pooled_like_any_inner_tensor(tmp_path, by):
    what = TinyNetwork()
    graph = tiny_graph(what)
    graph.output.append(helper.make_tensor_value_info("small", TensorProto.FLOAT, [1, 3, 60, 80]))
    named = {"descriptor_layer": "small", "descriptor_pooling": "mean"} if by == "card" else {}
    path, out = tmp_path / "net.onnx", tmp_path / "out.onnx"
    save(path, graph, replace(what.card(), **named))
    option = ["--layer", "small", "--pooling", "mean"] if by == "option" else []
    assert expose_descriptor.main([str(path), str(out), *option]) == 0
    network = OnnxNetwork(out)
    assert network.card.descriptor_layer == "small"
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    expected = pool(network._session.run(["small"], {"image": _input(image)})[0], "mean")
    assert network.raw(image)[0].descriptor == pytest.approx(expected, abs=1e-5)


def _input(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image.transpose(2, 0, 1)[None], np.float32) / np.float32(255)


def test_what_cannot_be_done_is_refused_in_one_line_and_leaves_no_file(tmp_path, capsys):
    path, out = write_tiny_network(tmp_path / "tiny.onnx"), tmp_path / "out.onnx"
    foreign = write_tiny_network(tmp_path / "foreign.onnx", TinyNetwork(describes_itself=False))
    (tmp_path / "text.onnx").write_text("no model")
    elsewhere = {"descriptor_layer": "gone", "descriptor_pooling": "grid"}
    save(tmp_path / "gone.onnx", tiny_graph(TinyNetwork()), replace(TinyNetwork().card(), **elsewhere))
    both = TinyNetwork(confidence=True)  # which of its two outputs is depth its card doesn't say
    mute = replace(both.card(), depth_output="", confidence_output="")
    save(tmp_path / "both.onnx", tiny_graph(both), mute)
    what = TinyNetwork(misbehaviour="zero")  # a constant 0 somewhere: its norm can't be 1
    save(tmp_path / "silent.onnx", tiny_graph(what), replace(what.card(), name="silent"))
    for arguments, says in (
        ([path, out, "--layer", "nowhere"], "no tensor 'nowhere'"),
        ([tmp_path / "gone.onnx", out], "no tensor 'gone' that its card names"),
        ([path, out, "--layer", "small", "--pooling", "token"], "does not go with"),
        ([path, path], "name another file"),
        ([tmp_path / "both.onnx", out, "--layer", "small"], "depth_output, one of depth, confidence"),
        ([foreign, out], "does not say what it predicts"),
        ([tmp_path / "text.onnx", out], "no ONNX model"),
        ([tmp_path / "absent.onnx", out], "can't be read"),
        ([tmp_path / "silent.onnx", out, "--layer", "scaled", "--pooling", "mean"], "norm"),
    ):
        assert expose_descriptor.main([str(argument) for argument in arguments]) != 0
        error = capsys.readouterr().err.strip()
        assert says in error
        assert "\n" not in error
        assert not out.exists()
    assert expose_descriptor.main([str(path), str(tmp_path / "nowhere" / "out.onnx")]) != 0
    error = capsys.readouterr().err.strip()
    assert "nowhere" in error
    assert "\n" not in error


def test_places_are_scored_by_true_poses():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[1:3, 0, 3] = 5.0  # frames 0 and 3 are one place, 1 and 2 another
    indices = np.array([0, 200, 400, 600])
    good = np.array([[1, 0], [0, 1], [0, 1], [1, 0]], float)
    score = measure_places.score_places(indices, poses, good)
    assert (score.revisits, score.auc, score.same, score.other, score.before_false) == (4, 1, 1, 0, 1)
    score = measure_places.score_places(indices, poses, good[[0, 1, 0, 1]])
    # Of four other pairs two are more alike than one of the same place, two as alike.
    assert (score.auc, score.same, score.other, score.before_false) == (0.25, 0, 1, 0)
    assert measure_places.score_places(np.arange(4), poses, good) is None  # never gone for long enough


def test_descriptors_that_are_all_alike_tell_no_place_from_another() -> None:
    indices, poses = np.arange(0, 1000, 50), np.tile(np.eye(4), (20, 1, 1))
    poses[::2, 0, 3] = 5.0
    score = measure_places.score_places(indices, poses, np.tile([0.6, 0.8], (20, 1)))
    assert score.auc == 0.5


def test_weights_of_gigabytes_are_not_handed_to_onnx_as_one_message(tmp_path, monkeypatch) -> None:
    """It can't take them; they are kept in a file beside the network, and come to no harm."""
    path, out = tmp_path / "net.onnx", tmp_path / "places.onnx"
    what = TinyNetwork()
    graph = tiny_graph(what)
    graph.initializer.append(numpy_helper.from_array(np.zeros(50_000, np.float32), "large"))
    graph.node.append(helper.make_node("ReduceSum", ["large"], ["unused"], keepdims=0))
    save(path, graph, what.card())
    infer = onnx.shape_inference.infer_shapes
    given = []

    def bounded(model: onnx.ModelProto) -> onnx.ModelProto:
        given.append(model.ByteSize())
        return infer(model)

    monkeypatch.setattr(onnx.shape_inference, "infer_shapes", bounded)
    monkeypatch.setattr(expose_descriptor, "_LARGEST_MESSAGE", 100_000)
    assert expose_descriptor.main([str(path), str(out), "--layer", "small", "--pooling", "mean"]) == 0
    assert given
    assert max(given) < 100_000
    assert out.with_name("places.onnx.data").stat().st_size >= 200_000
    # whoever may read the one may read the other
    assert out.with_name("places.onnx.data").stat().st_mode == out.stat().st_mode
    assert OnnxNetwork(out).card.descriptor_output == expose_descriptor.OUTPUT


def test_a_file_that_was_there_stays_where_the_new_one_is_not_what_it_should_be(
    tmp_path, capsys, monkeypatch
) -> None:
    path, out = write_tiny_network(tmp_path / "net.onnx", TinyNetwork()), tmp_path / "out.onnx"
    out.write_bytes(b"of last week")

    def differs(*_: object) -> None:
        raise ModelError("its depth is not the original's")

    monkeypatch.setattr(expose_descriptor, "_compare", differs)
    assert expose_descriptor.main([str(path), str(out)]) == 5
    assert out.read_bytes() == b"of last week"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["net.onnx", "out.onnx"]
