"""What a network says beside depth for whoever asks: the camera's intrinsics, and rays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper

from prism_edge.depth.session import OnnxNetwork
from prism_edge.errors import ModelError
from tests.synthetic.network import save, two_outputs, write_tiny_network

IMAGE = np.zeros((360, 640, 3), np.uint8)


@pytest.mark.parametrize("resize", ["stretch", "crop"])
@pytest.mark.parametrize("shape", [[1, 3, 3], [3, 3], [1, 1, 3, 3]])
def test_a_networks_own_intrinsics_come_in_pixels_of_the_image(tmp_path: Path, resize: str, shape):
    # 640x360 becomes 427x240, of which 53 columns are cut off at the left, or 320x240
    sx, sy, left = (427 / 640, 240 / 360, 53) if resize == "crop" else (320 / 640, 240 / 360, 0)
    said = [400 * sx, 0, 310.5 * sx - 0.5 - left, 0, 380 * sy, 170.5 * sy - 0.5, 0, 0, 1]
    graph, card = two_outputs()
    value = helper.make_tensor("matrix", TensorProto.FLOAT, shape, said)
    graph.node.append(helper.make_node("Constant", [], ["intrinsics"], value=value))
    graph.output.append(helper.make_tensor_value_info("intrinsics", TensorProto.FLOAT, shape))
    save(tmp_path / "net.onnx", graph, replace(card, intrinsics_output="intrinsics", resize=resize))
    found = OnnxNetwork(tmp_path / "net.onnx").intrinsics(IMAGE)
    assert found == pytest.approx([400, 380, 310, 170], rel=1e-5)


@pytest.mark.parametrize(
    ("role", "shape", "needed"),
    [
        ("intrinsics", [1, 3], "(1, 3, 3)"),
        ("intrinsics", [1, 9], "(1, 3, 3)"),
        ("intrinsics", [1, 1, 3, 3], ""),
        ("rays", [1, 3, 48, 64], "(1, h, w, 6)"),
        ("rays", [1, 6, 48, 64], "(1, h, w, 6)"),
        ("rays", [2, 48, 64, 6], "(1, h, w, 6)"),
        ("rays", [1, 48, 64, 6], ""),
    ],
)
def test_outputs_that_no_keyframe_asks_for_are_held_to_their_shapes(tmp_path: Path, role, shape, needed):
    graph, card = two_outputs()
    value = helper.make_tensor("value", TensorProto.FLOAT, shape, np.zeros(np.prod(shape)))
    graph.node.append(helper.make_node("Constant", [], [role], value=value))
    graph.output.append(helper.make_tensor_value_info(role, TensorProto.FLOAT, shape))
    save(tmp_path / "net.onnx", graph, replace(card, **{f"{role}_output": role}))
    network = OnnxNetwork(tmp_path / "net.onnx")
    if not needed:
        network.check_offline_outputs(IMAGE)
        return
    with pytest.raises(ModelError) as error:
        network.check_offline_outputs(IMAGE)
    assert str(error.value) == f"net.onnx: output {role!r} for {role} has shape {shape}, not {needed}"


def test_a_network_that_fails_at_an_image_has_no_intrinsics_and_says_so(tmp_path: Path, monkeypatch):
    graph, card = two_outputs()
    value = helper.make_tensor("matrix", TensorProto.FLOAT, [3, 3], np.eye(3).ravel())
    graph.node.append(helper.make_node("Constant", [], ["intrinsics"], value=value))
    graph.output.append(helper.make_tensor_value_info("intrinsics", TensorProto.FLOAT, [3, 3]))
    save(tmp_path / "net.onnx", graph, replace(card, intrinsics_output="intrinsics"))
    network = OnnxNetwork(tmp_path / "net.onnx")

    class Failing:
        def run(self, *_: object) -> None:
            raise RuntimeError("a foreign graph\nand where")

    monkeypatch.setattr(network, "_session", Failing())
    with pytest.raises(ModelError, match=r"^net.onnx: an inference failed \(a foreign graph"):
        network.intrinsics(IMAGE)


def test_intrinsics_that_can_not_be_are_none(tmp_path: Path):
    assert OnnxNetwork(write_tiny_network(tmp_path / "tiny.onnx")).intrinsics(IMAGE) is None
    mirrored = [[fx, 0.0, 310.0, 0.0, fy, 170.0, 0.0, 0.0, 1.0] for fx, fy in ((-400, 380), (400, -380))]
    for number, said in enumerate(([0.0] * 9, [float("nan")] * 9, *mirrored)):
        graph, card = two_outputs()
        value = helper.make_tensor("matrix", TensorProto.FLOAT, [3, 3], said)
        graph.node.append(helper.make_node("Constant", [], ["intrinsics"], value=value))
        graph.output.append(helper.make_tensor_value_info("intrinsics", TensorProto.FLOAT, [3, 3]))
        path = tmp_path / f"{number}.onnx"
        save(path, graph, replace(card, intrinsics_output="intrinsics"))
        assert OnnxNetwork(path).intrinsics(IMAGE) is None


def test_a_matrix_column_by_column_is_none_and_said_to_be(tmp_path: Path):
    """Its principal point would be the picture's corner."""
    graph, card = two_outputs()
    columns = [400.0, 0.0, 0.0, 0.0, 380.0, 0.0, 310.0, 170.0, 1.0]
    value = helper.make_tensor("matrix", TensorProto.FLOAT, [1, 3, 3], columns)
    graph.node.append(helper.make_node("Constant", [], ["intrinsics"], value=value))
    graph.output.append(helper.make_tensor_value_info("intrinsics", TensorProto.FLOAT, [1, 3, 3]))
    save(tmp_path / "net.onnx", graph, replace(card, intrinsics_output="intrinsics"))
    network = OnnxNetwork(tmp_path / "net.onnx")
    for ask in (network.intrinsics, network.check_offline_outputs):
        with pytest.raises(ModelError, match=r"'intrinsics' is no camera matrix: its last row is 310 170 1,"):
            ask(IMAGE)
