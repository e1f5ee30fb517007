"""A descriptor from an inner tensor: against the package onnx, and against closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from prism_edge.depth.inner_tensor import POOLINGS, pool, with_output
from prism_edge.depth.session import OnnxNetwork
from prism_edge.errors import ModelError
from tests.synthetic.network import TinyNetwork, save, tiny_graph, write_sidecar, write_tiny_network


@settings(max_examples=30, deadline=None)
@given(st.text(min_size=1, max_size=300))
def test_the_appended_bytes_are_read_as_one_more_output(name: str):
    value = helper.make_tensor_value_info("depth", TensorProto.FLOAT, [1])
    model = helper.make_model(helper.make_graph([], "g", [], [value]))
    read = onnx.load_from_string(with_output(model.SerializeToString(), name))
    assert [output.name for output in read.graph.output] == ["depth", name]
    del read.graph.output[1]
    assert read == model


def test_the_named_tensor_comes_out_beside_an_unchanged_depth(tmp_path: Path):
    path = write_tiny_network(tmp_path / "tiny.onnx")
    plain = onnxruntime.InferenceSession(str(path))
    more = onnxruntime.InferenceSession(with_output(path.read_bytes(), "small"))
    image = np.random.default_rng(1).random((1, 3, 240, 320), dtype=np.float32)
    depth, small = more.run(["depth", "small"], {"image": image})
    assert np.array_equal(depth, plain.run(["depth"], {"image": image})[0])
    assert small == pytest.approx(image.reshape(1, 3, 60, 4, 80, 4).mean(axis=(3, 5)), abs=1e-6)


MAP = np.array(
    [
        [[6, 6, 0, 0], [6, 6, 6, 0], [6, 0, 0, 0]],
        [[2, 2, 2, 0], [0, 0, 0, 0], [0, 0, 0, 4]],
    ],
    np.float32,
)[None]  # (1, 2, 3, 4)


@pytest.mark.parametrize(
    ("pooling", "expected"),
    [
        ("mean", [3.0, 10 / 12]),
        ("max", [6.0, 4.0]),
        ("gem", [(6 * 216 / 12) ** (1 / 3), (88 / 12) ** (1 / 3)]),
        # quarters of one and two rows: top left, top right, bottom left, bottom right, each of two channels
        ("grid", [6, 2, 0, 1, 18 / 4, 0, 6 / 4, 1]),
    ],
)
def test_pooling_a_map(pooling: str, expected: list[float]):
    got = pool(MAP, pooling)
    assert got.dtype == np.float32
    assert got == pytest.approx(np.array(expected) / np.linalg.norm(expected), abs=1e-5)


def test_the_first_token_is_the_class_token_and_the_rest_can_be_averaged():
    tokens = np.array([[[3.0, 4.0], [0.0, 2.0], [0.0, 0.0]]], np.float32)
    assert pool(tokens, "token") == pytest.approx([0.6, 0.8])
    assert pool(tokens, "mean") == pytest.approx(np.array([1.0, 2.0]) / np.sqrt(5))
    assert pool(tokens, "max") == pytest.approx([0.6, 0.8])


def test_a_silent_tensor_gives_no_descriptor():
    assert pool(np.zeros((1, 5, 2, 2), np.float32), "mean").shape == (0,)
    assert pool(np.full((1, 5, 2, 2), -1.0, np.float32), "mean").shape == (5,)


@pytest.mark.parametrize(
    ("shape", "pooling"),
    [
        ((1, 4, 3, 3), "token"),
        ((1, 4, 3), "grid"),
        ((1, 4, 1, 3), "grid"),
        ((2, 4, 3), "mean"),
        ((1, 0, 3), "mean"),
        ((7,), "mean"),
        ((1, 4, 3), "sum"),
    ],
)
def test_tensors_that_do_not_go_with_a_pooling_are_refused(shape: tuple[int, ...], pooling: str):
    with pytest.raises(ModelError):
        pool(np.ones(shape, np.float32), pooling)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(POOLINGS), st.tuples(*[st.integers(2, 7)] * 3), st.floats(0.01, 100))
def test_a_descriptor_has_unit_norm_whatever_the_gain(pooling: str, sizes: tuple[int, ...], gain: float):
    shape = (1, *sizes[:2]) if pooling == "token" else (1, *sizes)
    values = np.random.default_rng(sum(sizes)).random(shape).astype(np.float32) + 0.1
    got = pool(values, pooling)
    assert np.linalg.norm(got) == pytest.approx(1.0, abs=1e-5)
    assert got == pytest.approx(pool(values * np.float32(gain), pooling), abs=1e-3)


def test_the_session_exposes_the_layer_that_the_card_names(tmp_path: Path):
    what = TinyNetwork()
    card = replace(what.card(), descriptor_layer="small", descriptor_pooling="grid")
    save(tmp_path / "a.onnx", tiny_graph(what), card)
    plain = OnnxNetwork(write_tiny_network(tmp_path / "b.onnx"))
    image = np.random.default_rng(2).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    described, bare = OnnxNetwork(tmp_path / "a.onnx").raw(image)[0], plain.raw(image)[0]
    assert np.array_equal(described.depth, bare.depth)
    assert bare.descriptor.size == 0
    quarters = (image / 255.0).reshape(2, 120, 2, 160, 3).mean(axis=(1, 3)).reshape(-1)
    assert described.descriptor == pytest.approx(quarters / np.linalg.norm(quarters), abs=1e-5)


@pytest.mark.parametrize(
    ("layer", "pooling", "says"),
    [("nowhere", "mean", "no inner tensor 'nowhere'"), ("small", "token", "no first token")],
)
def test_a_layer_that_is_not_there_or_cannot_be_pooled_is_refused(tmp_path: Path, layer, pooling, says):
    what = TinyNetwork(describes_itself=False)
    path = write_tiny_network(tmp_path / "a.onnx", what)
    write_sidecar(path, replace(what.card(), descriptor_layer=layer, descriptor_pooling=pooling))
    with pytest.raises(ModelError, match=says) as error:
        OnnxNetwork(path)
    assert "\n" not in str(error.value)


def test_a_pooled_descriptor_is_no_longer_than_an_output_may_be(tmp_path: Path):
    graph = tiny_graph(TinyNetwork())
    for node in (  # 3 x 240 x 320 numbers as tokens of 23040
        helper.make_node("Constant", [], ["wide"], value_ints=[1, 10, 23040]),
        helper.make_node("Reshape", ["image", "wide"], ["tokens"]),
    ):
        graph.node.append(node)
    card = replace(TinyNetwork().card(), descriptor_layer="tokens", descriptor_pooling="mean")
    save(tmp_path / "a.onnx", graph, card)
    with pytest.raises(ModelError, match="'tokens' gives 23040 numbers, more than 16384"):
        OnnxNetwork(tmp_path / "a.onnx")


def test_an_exposed_layer_leaves_the_only_output_the_only_one(tmp_path: Path):
    path = write_tiny_network(tmp_path / "a.onnx", TinyNetwork(describes_itself=False))
    card = replace(TinyNetwork().card(), depth_output="", descriptor_layer="small", descriptor_pooling="grid")
    write_sidecar(path, card)
    assert OnnxNetwork(path).raw(np.full((48, 64, 3), 90, np.uint8))[0].descriptor.size == 12


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("file", "size"), [("fastdepth_nyu_224", 1504), ("depth_anything_v2_small_252x336_int8", 1536)]
)
def test_registered_networks_give_a_descriptor_from_their_plain_files(shared: Path, file: str, size: int):
    network = OnnxNetwork(shared / "models" / f"{file}.onnx")
    image = np.random.default_rng(3).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    answer = network.raw(image)[0]
    assert answer.descriptor.shape == (size,)
    assert np.linalg.norm(answer.descriptor) == pytest.approx(1.0, abs=1e-5)
