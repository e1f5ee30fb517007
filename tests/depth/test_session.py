"""A network file in onnxruntime: held to its card, turned into metres, refused in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from prism_edge.depth.session import OnnxNetwork
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import Camera
from tests.depth.ruler import ramp, write_ruler
from tests.synthetic.network import (
    TinyNetwork,
    save,
    tiny_graph,
    two_outputs,
    write_sidecar,
    write_tiny_network,
)
from tests.synthetic.sequence import synthetic_camera
from tests.synthetic.tint import tinted

CAMERA = synthetic_camera()


def slanted_wall() -> tuple[np.ndarray, np.ndarray]:
    """RGB image of a grey wall that recedes from 1 to 4 m, and its depth."""
    across = np.linspace(1.0, 4.0, CAMERA.width, dtype=np.float32)
    depth = np.broadcast_to(across, (CAMERA.height, CAMERA.width))
    image = tinted(np.full(depth.shape, 125, np.uint8), np.ascontiguousarray(depth))
    return np.ascontiguousarray(image[:, :, ::-1]), depth


@pytest.fixture
def tiny(tmp_path: Path) -> OnnxNetwork:
    return OnnxNetwork(write_tiny_network(tmp_path / "tiny.onnx"))


@pytest.mark.parametrize("size", [(640, 480), (640, 360), (333, 517), (1241, 376), (224, 224)])
@pytest.mark.parametrize("network", [(224, 224), (336, 252), (160, 200)])
@pytest.mark.parametrize("resize", ["stretch", "crop"])
def test_focal_normalised_depth_is_metres_at_every_size_and_aspect(tmp_path: Path, size, network, resize):
    width, height = size
    x, y = np.arange(width) - 0.47 * width, np.arange(height)[:, None] - 0.52 * height
    sigma = min(width, height) / 16
    image = np.round(200 * np.exp(-(x**2 + y**2) / (2 * sigma**2))).astype(np.uint8)
    camera = Camera(width, height, 0.8 * width, 0.93 * width, width / 2, height / 2)
    metres = 2.0
    # how bright the thing must be, in m^2, to look like this from two metres
    brightness = float(image.sum()) / 255 * metres**2 / (camera.fx * camera.fy)
    path = write_ruler(tmp_path / "ruler.onnx", *network, f0=300.0, brightness=brightness, resize=resize)
    answer = OnnxNetwork(path).infer(np.repeat(image[:, :, None], 3, axis=2), camera)
    assert answer.valid
    assert answer.depth / ramp() == pytest.approx(metres, rel=1e-4)


def test_depth_lies_where_image_to_depth_says(tiny: OnnxNetwork):
    image, depth = slanted_wall()
    answer = tiny.infer(image, CAMERA)
    assert answer.valid
    rows, columns = np.mgrid[0 : answer.depth.shape[0], 0 : answer.depth.shape[1]]
    a, b, c, d = answer.image_to_depth
    x, y = ((columns - b) / a).astype(np.float32), ((rows - d) / c).astype(np.float32)
    truth = cv2.remap(np.ascontiguousarray(depth), x, y, cv2.INTER_LINEAR)
    inner = (slice(None), slice(1, -1))
    error = np.log(answer.depth[inner] / truth[inner])
    # half a pixel of the depth map would be 1.2 % at the near end and of one sign
    assert abs(np.median(error[:, :10])) < 0.003
    assert np.abs(error).max() < 0.03


def test_confidence_and_descriptor_are_stated_not_invented(tmp_path: Path, tiny: OnnxNetwork):
    image, _ = slanted_wall()
    without = tiny.infer(image, CAMERA)
    assert without.confidence.shape == (0, 0)
    assert without.descriptor.shape == (0,)
    path = write_tiny_network(tmp_path / "more.onnx", TinyNetwork(confidence=True, descriptor=True))
    given = OnnxNetwork(path).infer(image, CAMERA)
    assert given.confidence.shape == given.depth.shape
    assert np.all(given.confidence > 1.0)
    assert given.descriptor.shape == (75,)
    assert np.ptp(given.descriptor) > 0


def test_confidence_is_held_to_the_kind_that_the_card_names(tmp_path: Path):
    what = TinyNetwork(confidence=True)  # between 1 and 2
    card = replace(what.card(), confidence_kind="probability")
    save(tmp_path / "net.onnx", tiny_graph(what), card)
    assert np.all(OnnxNetwork(tmp_path / "net.onnx").infer(slanted_wall()[0], CAMERA).confidence == 1.0)


@pytest.mark.parametrize(
    ("kind", "addend", "doubted"),
    [
        ("probability", 1.0, "100 % of its confidence is above 1"),
        ("probability", 0.0, ""),
        ("open", 1.0, ""),
        ("open", 0.0, "100 % of its confidence is between 0 and 1"),
        ("", 1.0, ""),
        ("", 0.0, ""),
    ],
)
def test_confidence_of_another_kind_is_said_once(tmp_path: Path, caplog, kind, addend, doubted):
    what = TinyNetwork(confidence=True)  # a sigmoid and ``one``
    graph = tiny_graph(what)
    (one,) = (tensor for tensor in graph.initializer if tensor.name == "one")
    one.CopyFrom(helper.make_tensor("one", TensorProto.FLOAT, [1], [addend]))
    save(tmp_path / "net.onnx", graph, replace(what.card(), confidence_kind=kind))
    network = OnnxNetwork(tmp_path / "net.onnx")
    for _ in range(3):
        network.infer(slanted_wall()[0], CAMERA)
    assert caplog.text.count(f"tiny_tint: {doubted}") == (1 if doubted else 0)
    assert len(caplog.records) == (1 if doubted else 0)


@pytest.mark.parametrize("kind", ["metric", "focal_normalised"])
def test_millimetres_become_metres_by_the_card(tmp_path: Path, kind: str):
    image, _ = slanted_wall()
    metres = OnnxNetwork(write_tiny_network(tmp_path / "m.onnx", TinyNetwork(depth_kind=kind)))
    what = TinyNetwork(depth_kind=kind, gain=1000.0)
    save(tmp_path / "mm.onnx", tiny_graph(what), replace(what.card(), depth_scale=0.001))
    millimetres = OnnxNetwork(tmp_path / "mm.onnx")
    expected = metres.infer(image, CAMERA).depth
    assert millimetres.infer(image, CAMERA).depth == pytest.approx(expected, rel=1e-5)
    assert np.median(millimetres.raw(image)[0].depth) > 1000  # its own unit


def test_a_descriptor_is_one_vector_of_norm_one(tmp_path: Path):
    path = write_tiny_network(tmp_path / "more.onnx", TinyNetwork(descriptor=True))
    network = OnnxNetwork(path)
    image, _ = slanted_wall()
    answer = network.infer(image, CAMERA)
    assert np.linalg.norm(answer.descriptor) == pytest.approx(1.0, abs=1e-6)
    raw = network.raw(image)[0].descriptor
    assert np.linalg.norm(raw) != pytest.approx(1.0, abs=0.1)
    assert answer.descriptor == pytest.approx(raw / np.linalg.norm(raw), abs=1e-6)
    graph, card = two_outputs()
    save(tmp_path / "map.onnx", graph, replace(card, descriptor_output="other"))
    _refused(tmp_path / "map.onnx", "no descriptor of one vector")


def test_a_network_of_several_views_is_refused(tmp_path: Path):
    save(tmp_path / "net.onnx", tiny_graph(TinyNetwork()), replace(TinyNetwork().card(), views=5))
    _refused(tmp_path / "net.onnx", "takes 5 images at once")


def test_sky_has_no_depth(tmp_path: Path):
    graph, card = two_outputs()
    save(tmp_path / "sky.onnx", graph, replace(card, sky_output="other", sky_limit=2.0))
    answer = OnnxNetwork(tmp_path / "sky.onnx").infer(slanted_wall()[0], CAMERA)
    assert answer.valid
    assert np.all(answer.depth[:, -5:] == 0)  # the other output is the depth itself: far away is sky
    assert np.all(answer.depth[:, :5] > 0)


def test_a_picture_that_is_all_sky_is_said_to_be(tmp_path: Path):
    graph = tiny_graph(what := TinyNetwork())
    save(tmp_path / "sky.onnx", graph, replace(what.card(), sky_output="depth", sky_limit=0.0))
    answer = OnnxNetwork(tmp_path / "sky.onnx").infer(slanted_wall()[0], CAMERA)
    assert not answer.valid
    assert "100 % is sky, 'depth' at or above sky_limit 0" in answer.reason


def test_sky_of_another_size_than_depth_is_refused(tmp_path: Path):
    graph, card = two_outputs()
    graph.node.append(helper.make_node("MaxPool", ["depth"], ["sky"], kernel_shape=[2, 2], strides=[2, 2]))
    graph.output.append(helper.make_tensor_value_info("sky", TensorProto.FLOAT, [1, 1, 30, 40]))
    save(tmp_path / "sky.onnx", graph, replace(card, sky_output="sky", sky_limit=2.0))
    _refused(tmp_path / "sky.onnx", "sky is .* depth .* they must be of one size")


def test_an_input_whose_shape_is_not_said_may_be_any(tmp_path: Path):
    what = TinyNetwork()
    graph = tiny_graph(what)
    save(tmp_path / "net.onnx", graph, what.card())
    model = onnx.load(tmp_path / "net.onnx")
    model.graph.input[0].type.tensor_type.ClearField("shape")
    onnx.save(model, tmp_path / "net.onnx")
    image = slanted_wall()[0]
    said = OnnxNetwork(tmp_path / "net.onnx").infer(image, CAMERA).depth
    expected = OnnxNetwork(write_tiny_network(tmp_path / "tiny.onnx")).infer(image, CAMERA).depth
    np.testing.assert_array_equal(said, expected)


def test_the_only_output_is_depth_though_it_be_pooled_as_well(tmp_path: Path):
    what = TinyNetwork()
    card = replace(what.card(), depth_output="", descriptor_layer="depth", descriptor_pooling="grid")
    save(tmp_path / "net.onnx", tiny_graph(what), card)
    answer = OnnxNetwork(tmp_path / "net.onnx").infer(slanted_wall()[0], CAMERA)
    assert answer.valid
    assert answer.descriptor.size == 4


@pytest.mark.filterwarnings("error")
def test_depth_beyond_all_numbers_is_none(tmp_path: Path):
    what = TinyNetwork(gain=1e35)
    save(tmp_path / "net.onnx", tiny_graph(what), replace(what.card(), depth_scale=1e5))
    answer = OnnxNetwork(tmp_path / "net.onnx").infer(slanted_wall()[0], CAMERA)
    assert not answer.valid
    assert "infinite" in answer.reason


@pytest.mark.parametrize("misbehaviour", ["nan", "zero", "negative", "constant"])
def test_a_useless_answer_is_marked_invalid(tmp_path: Path, misbehaviour: str):
    path = write_tiny_network(tmp_path / "bad.onnx", TinyNetwork(misbehaviour=misbehaviour))
    answer = OnnxNetwork(path).infer(slanted_wall()[0], CAMERA)
    assert not answer.valid
    assert answer.reason
    assert not answer.depth.any()


def test_half_an_answer_is_used(tmp_path: Path):
    path = write_tiny_network(tmp_path / "half.onnx", TinyNetwork(misbehaviour="half_nan"))
    answer = OnnxNetwork(path).infer(slanted_wall()[0], CAMERA)
    assert answer.valid
    assert not answer.depth[:, :40].any()
    assert np.all(answer.depth[:, 40:] > 0)


def test_image_and_camera_of_different_size_are_refused(tiny: OnnxNetwork):
    with pytest.raises(ModelError, match="not of its camera"):
        tiny.infer(np.zeros((100, 100, 3), np.uint8), CAMERA)


def test_a_relative_network_gives_no_metres(tmp_path: Path):
    network = OnnxNetwork(write_tiny_network(tmp_path / "r.onnx", TinyNetwork(depth_kind="inverse_relative")))
    with pytest.raises(ModelError, match="no metres"):
        network.infer(slanted_wall()[0], CAMERA)


@pytest.mark.parametrize("content", [b"", b"not a network", b"\x08\x08\x12\x00" * 50])
def test_what_is_no_onnx_is_refused_in_one_line(tmp_path: Path, content: bytes):
    path = tmp_path / "net.onnx"
    path.write_bytes(content)
    _refused(path, "no ONNX model|does not say")


def test_a_truncated_file_is_refused(tmp_path: Path):
    whole = write_tiny_network(tmp_path / "tiny.onnx").read_bytes()
    path = tmp_path / "cut.onnx"
    path.write_bytes(whole[: len(whole) // 2])
    _refused(path, "no ONNX model")


def test_a_missing_file_is_refused(tmp_path: Path):
    _refused(tmp_path / "none.onnx", "can't be read")


def test_a_file_without_a_card_says_where_to_describe_it(tmp_path: Path):
    path = write_tiny_network(tmp_path / "mute.onnx", TinyNetwork(describes_itself=False))
    _refused(path, "mute.onnx.yaml")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"input_name": "picture"}, "no input 'picture'"),
        ({"input_width": 224}, "has shape"),
        ({"depth_output": "metres"}, "no output 'metres'"),
        ({"confidence_output": "trust"}, "no output 'trust'"),
        ({"rays_output": "beams"}, "no output 'beams' for rays"),
        ({"intrinsics_output": "K"}, "no output 'K' for intrinsics"),
    ],
)
def test_a_file_that_is_not_what_its_card_says_is_refused(tmp_path: Path, change, says):
    path = write_tiny_network(tmp_path / "net.onnx", TinyNetwork(describes_itself=False))
    write_sidecar(path, replace(TinyNetwork().card(), **change))
    _refused(path, says)


def test_an_unnamed_depth_output_must_be_the_only_one(tmp_path: Path):
    graph, card = two_outputs()
    save(tmp_path / "net.onnx", graph, replace(card, depth_output=""))
    _refused(tmp_path / "net.onnx", "must name depth_output, one of depth, other")


@pytest.mark.parametrize(
    ("kind", "shape", "says"),
    [
        (TensorProto.UINT8, [1, 3, 240, 320], "float32 is needed"),
        (TensorProto.FLOAT, [1, 240, 320, 3], "has shape"),
        (TensorProto.FLOAT, [3, 240, 320], "has shape"),
        (TensorProto.FLOAT, [2, 3, 240, 320], "has shape"),
    ],
)
def test_an_input_of_another_type_or_shape_is_refused(tmp_path: Path, kind, shape, says):
    nodes = [helper.make_node("Cast", ["image"], ["depth"], to=TensorProto.FLOAT)]
    save(tmp_path / "net.onnx", _graph(nodes, kind, shape, shape), TinyNetwork().card())
    _refused(tmp_path / "net.onnx", says)


def test_an_output_that_is_no_map_is_refused(tmp_path: Path):
    nodes = [helper.make_node("Identity", ["image"], ["depth"])]  # three planes
    shape = [1, 3, 240, 320]
    save(tmp_path / "net.onnx", _graph(nodes, TensorProto.FLOAT, shape, shape), TinyNetwork().card())
    _refused(tmp_path / "net.onnx", "no map of one value a pixel")


def test_a_graph_that_fails_at_the_first_inference_is_refused(tmp_path: Path):
    shape = [1, 3, 240, 320]
    beyond = helper.make_tensor("columns", TensorProto.INT64, [320], [99_999] * 320)
    nodes = [
        helper.make_node("ReduceMax", ["image"], ["largest"], keepdims=0),
        helper.make_node("Cast", ["largest"], ["whole"], to=TensorProto.INT64),
        helper.make_node("Constant", [], ["columns"], value=beyond),
        helper.make_node("Add", ["columns", "whole"], ["where"]),  # known only once it runs
        helper.make_node("Gather", ["image", "where"], ["depth"], axis=3),
    ]
    save(tmp_path / "net.onnx", _graph(nodes, TensorProto.FLOAT, shape, shape), TinyNetwork().card())
    _refused(tmp_path / "net.onnx", "first inference failed")


def test_two_inferences_of_one_image_are_identical(tiny: OnnxNetwork):
    image, _ = slanted_wall()
    assert np.array_equal(tiny.infer(image, CAMERA).depth, tiny.infer(image, CAMERA).depth)


@pytest.mark.realdata
def test_fastdepth_has_metres_once_its_focal_length_is_right(fastdepth: Path, redkitchen: Path):
    network = OnnxNetwork(fastdepth)
    assert (network.name, network.bias_sigma) == ("fastdepth_nyu", 0.10)
    ratios = []
    for i in range(0, 1000, 66):
        image = cv2.imread(str(redkitchen / f"frame-{i:06d}.color.jpg"))
        kinect = cv2.imread(str(redkitchen / f"frame-{i:06d}.depth.png"), cv2.IMREAD_UNCHANGED) / 1000.0
        answer = network.infer(np.ascontiguousarray(image[:, :, ::-1]), Camera(640, 480, 525, 525, 320, 240))
        truth = cv2.resize(kinect, (224, 224), interpolation=cv2.INTER_NEAREST)
        seen = (truth > 0.3) & (answer.depth > 0)
        ratios.append(np.median(truth[seen] / answer.depth[seen]))
    # Without the focal length it would be 0.91 (the canonical one is 8 % longer).
    assert np.exp(np.mean(np.log(ratios))) == pytest.approx(1.0, abs=0.05)


def _refused(path: Path, says: str) -> None:
    with pytest.raises(ModelError, match=says) as error:
        OnnxNetwork(path)
    assert "\n" not in str(error.value)


def _graph(nodes, kind, shape, out_shape):
    image = helper.make_tensor_value_info("image", kind, shape)
    depth = helper.make_tensor_value_info("depth", TensorProto.FLOAT, out_shape)
    return helper.make_graph(nodes, "g", [image], [depth])


@pytest.mark.parametrize(("size", "refused"), [((96, 72), True), ((72, 96), True), ((96, 96), False)])
def test_depth_whose_axes_are_swapped_is_refused(tmp_path: Path, size, refused):
    """Each pixel would have another one's depth."""
    what = TinyNetwork(width=size[0], height=size[1])
    graph = tiny_graph(what)
    graph.node[-1].output[:] = ["upright"]
    graph.node.append(helper.make_node("Transpose", ["upright"], ["depth"], perm=[0, 1, 3, 2]))
    shape = graph.output[0].type.tensor_type.shape.dim
    shape[2].dim_value, shape[3].dim_value = shape[3].dim_value, shape[2].dim_value
    save(tmp_path / "turned.onnx", graph, what.card())
    if refused:
        with pytest.raises(ModelError, match="axes are swapped"):
            OnnxNetwork(tmp_path / "turned.onnx")
    else:
        OnnxNetwork(tmp_path / "turned.onnx")
