"""Bad network files: each is refused in one line, before onnxruntime has seen it."""

from __future__ import annotations

import hashlib
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from prism_edge.depth import vetting
from prism_edge.depth.cards import card_of
from prism_edge.depth.fingerprint import fingerprint
from prism_edge.depth.registry import File, sha256_of
from prism_edge.depth.session import OnnxNetwork
from prism_edge.depth.vetting import vet
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import Camera
from tests.synthetic.network import TinyNetwork, save, tiny_graph, write_sidecar, write_tiny_network

SECRET = b"\x00\x00\x80?" * 1000


def split(path: Path, location: str = "weights.bin") -> Path:
    """A network whose weights lie in a file beside it, as exporters write those above 2 GB."""
    what = TinyNetwork(describes_itself=False)
    model = helper.make_model(tiny_graph(what), opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, str(path), save_as_external_data=True, location=location, size_threshold=0)
    write_sidecar(path, what.card())
    return path


def redirected(path: Path, location: str, **more: str) -> Path:
    """The same, but its tensors are to be read from ``location``."""
    split(path)
    model = onnx.load(path, load_external_data=False)
    for tensor in model.graph.initializer:
        for entry in tensor.external_data:
            if entry.key == "location":
                entry.value = location
        for key, value in more.items():
            kept = [e for e in tensor.external_data if e.key != key]
            del tensor.external_data[:]
            tensor.external_data.extend(kept)
            tensor.external_data.add(key=key, value=value)
    path.write_bytes(model.SerializeToString())
    return path


def refused(path: Path, says: str) -> None:
    """By the vetting, and so by whoever opens the network; in one line that names the file."""
    for attempt in (vet, OnnxNetwork):
        with pytest.raises(ModelError, match=says) as error:
            attempt(path)
        assert "\n" not in str(error.value)
        assert path.name in str(error.value)


def test_a_sound_file_passes_with_its_digest(tmp_path: Path):
    path = write_tiny_network(tmp_path / "net.onnx")
    vetted = vet(path)
    assert (vetted.path, vetted.sha256, vetted.opset) == (path, sha256_of(path), 13)
    assert vetted.metadata["prism_edge.name"] == "tiny_tint"
    assert vetted.data == ()
    assert vet(path, sha256_of(path)) == vetted


def test_a_network_with_weights_beside_it_runs_like_the_whole_one(tmp_path: Path):
    path = split(tmp_path / "split.onnx")
    assert vet(path).data == (tmp_path / "weights.bin",)
    image = np.tile(np.arange(320, dtype=np.uint8)[None, :, None], (240, 1, 3))
    camera = Camera(320, 240, 300.0, 300.0, 160.0, 120.0)
    one = OnnxNetwork(path).infer(image, camera)
    other = OnnxNetwork(write_tiny_network(tmp_path / "whole.onnx")).infer(image, camera)
    assert np.array_equal(one.depth, other.depth)


def test_weights_overwritten_under_a_running_network_are_noticed(tmp_path: Path):
    network = OnnxNetwork(split(tmp_path / "split.onnx"))
    image, camera = np.full((240, 320, 3), 90, np.uint8), Camera(320, 240, 300.0, 300.0, 160.0, 120.0)
    image[:, 100:] = 120
    before = network.infer(image, camera)
    weights = tmp_path / "weights.bin"
    other = np.frombuffer(weights.read_bytes(), np.float32) * np.float32(5)
    (tmp_path / "new").write_bytes(other.tobytes())
    kept = tmp_path / "kept"
    os.link(weights, kept)
    os.replace(tmp_path / "new", weights)  # as mv does
    assert np.array_equal(network.infer(image, camera).depth, before.depth)
    os.replace(kept, weights)
    os.utime(weights, ns=(0, 1))  # a write within the clock's tick would go unseen
    with pytest.raises(ModelError, match=r"weights.bin: was overwritten while the network runs"):
        network.infer(image, camera)


def test_a_folder_of_links_says_what_to_do(tmp_path: Path):
    blobs, shown = tmp_path / "blobs", tmp_path / "snapshot"
    blobs.mkdir()
    shown.mkdir()
    split(shown / "net.onnx")
    for name, blob in (("net.onnx", "aa"), ("weights.bin", "bb")):
        os.replace(shown / name, blobs / blob)
        (shown / name).symlink_to(blobs / blob)
    refused(shown / "net.onnx", "'weights.bin' lies beside the link alone; copy both files, not the links")


def test_of_a_link_whose_weights_are_nowhere_it_is_not_said_that_they_lie_beside_it(tmp_path: Path):
    (tmp_path / "store").mkdir()
    (split(tmp_path / "store" / "net.onnx").parent / "weights.bin").unlink()
    link = tmp_path / "net.onnx"
    link.symlink_to(tmp_path / "store" / "net.onnx")
    refused(link, "'weights.bin' is not beside it")


def test_a_link_to_a_network_is_followed_to_its_weights(tmp_path: Path):
    (tmp_path / "store").mkdir()
    (tmp_path / "links").mkdir()
    whole = split(tmp_path / "store" / "net.onnx")
    link = tmp_path / "links" / "net.onnx"
    link.symlink_to(whole)
    write_sidecar(link, TinyNetwork().card())
    assert OnnxNetwork(link).name == "tiny_tint"


@pytest.mark.parametrize(
    ("location", "says"),
    [
        ("/etc/passwd", "outside its own folder"),
        ("../secret.bin", "outside its own folder"),
        ("inner/../../secret.bin", "outside its own folder"),
        ("..", "outside its own folder"),
        ("C:\\secret.bin", "no plain file name"),
        ("..\\secret.bin", "no plain file name"),
        ("*/_ORT_MEM_ADDR_/*", "no plain file name"),
        ("", "no plain file name"),
        (".", "no plain file"),
        ("a\nb", "no plain file name"),
        ("nowhere.bin", "not beside it"),
        ("x" * 5000, "not beside it"),
    ],
)
def test_external_data_elsewhere_is_refused(tmp_path: Path, location: str, says: str):
    (tmp_path / "secret.bin").write_bytes(SECRET)
    folder = tmp_path / "model"
    folder.mkdir()
    refused(redirected(folder / "net.onnx", location), says)


def with_function(path: Path, location: str) -> Path:
    """A network that adds what lies in ``location``, which is a default of a function's attribute."""
    what = TinyNetwork()
    graph = tiny_graph(what)
    graph.node[-1].output[0] = "sum_in"
    graph.node.append(helper.make_node("Hidden", ["sum_in"], ["depth"], domain="mine"))
    tensor = TensorProto(name="t", data_type=TensorProto.FLOAT, dims=[4])
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", "0"), ("length", "16")):
        tensor.external_data.add(key=key, value=value)
    nodes = [
        helper.make_node("Constant", [], ["c"]),
        helper.make_node("ReduceSum", ["c"], ["s"], keepdims=0),
        helper.make_node("Add", ["x", "s"], ["y"]),
    ]
    nodes[0].attribute.add(name="value", ref_attr_name="value", type=onnx.AttributeProto.TENSOR)
    default, own = helper.make_attribute("value", tensor), helper.make_opsetid("", 13)
    function = helper.make_function("mine", "Hidden", ["x"], ["y"], nodes, [own], attribute_protos=[default])
    opsets = [own, helper.make_opsetid("mine", 1)]
    model = helper.make_model(graph, opset_imports=opsets, functions=[function], ir_version=9)
    helper.set_model_props(model, what.card().to_metadata())
    path.write_bytes(model.SerializeToString())
    return path


@pytest.mark.parametrize("location", ["../secret.bin", "/etc/passwd", "link.bin"])
def test_external_data_of_a_functions_defaults_is_vetted_too(tmp_path: Path, location: str):
    (tmp_path / "secret.bin").write_bytes(SECRET)
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    says = "symbolic link" if location == "link.bin" else "outside its own folder"
    refused(with_function(folder / "net.onnx", location), says)


def test_data_of_a_functions_defaults_in_the_own_folder_are_the_networks(tmp_path: Path):
    (tmp_path / "own.bin").write_bytes(SECRET)
    path = with_function(tmp_path / "net.onnx", "own.bin")
    vetted = vet(path)
    assert vetted.data == (tmp_path / "own.bin",)
    card = TinyNetwork().card()
    before = fingerprint(card, vetted)
    (tmp_path / "own.bin").write_bytes(SECRET[::-1])
    assert fingerprint(card, vet(path)) != before
    pinned = (File("net.onnx", vetted.sha256), File("own.bin", hashlib.sha256(SECRET).hexdigest()))
    with pytest.raises(ModelError, match=r"own\.bin: its SHA-256"):
        card_of(path, vetted, pinned)


@pytest.mark.parametrize("name", ["net.onnx", "net.ort"])
def test_what_was_read_as_onnx_is_loaded_as_onnx(tmp_path: Path, name: str):
    """onnxruntime has a format of its own, known by its fifth to eighth byte or by the file's ending."""
    what = TinyNetwork()
    card = replace(what.card(), descriptor_layer="small", descriptor_pooling="grid")
    path = tmp_path / name
    save(path, tiny_graph(what), card)
    producer = b"\x00\x00ORTM".ljust(64)
    path.write_bytes(b"\x12\x40" + producer + path.read_bytes())
    assert OnnxNetwork(path).name == what.name


@pytest.mark.parametrize("what", ["the file", "its folder"])
def test_external_data_behind_a_symbolic_link_is_refused(tmp_path: Path, what: str):
    outside, folder = tmp_path / "outside", tmp_path / "model"
    outside.mkdir()
    folder.mkdir()
    (outside / "weights.bin").write_bytes(SECRET)
    if what == "the file":
        path = split(folder / "net.onnx")
        (folder / "weights.bin").unlink()
        (folder / "weights.bin").symlink_to(outside / "weights.bin")
    else:
        path = redirected(folder / "net.onnx", "sub/weights.bin")
        (folder / "sub").symlink_to(outside)
    refused(path, "symbolic link")


def test_external_data_that_is_no_plain_file_is_refused(tmp_path: Path):
    path = split(tmp_path / "net.onnx")
    (tmp_path / "weights.bin").unlink()
    os.mkfifo(tmp_path / "weights.bin")  # whoever opened it for reading would wait for ever
    refused(path, "no plain file")


def test_external_data_cut_off_is_refused(tmp_path: Path):
    path = split(tmp_path / "net.onnx")
    data = tmp_path / "weights.bin"
    data.write_bytes(data.read_bytes()[:-100])
    refused(path, "cut off")


def test_external_data_whose_place_can_not_be_is_refused(tmp_path: Path):
    refused(redirected(tmp_path / "net.onnx", "weights.bin", offset="999999999999999999"), "are needed")


def test_an_oversized_file_is_refused_unread(tmp_path: Path):
    path = tmp_path / "net.onnx"
    with path.open("wb") as file:
        file.truncate(2**31)  # sparse: it takes no room on the disk
    refused(path, "larger than 2 GB")


def test_oversized_external_data_is_refused(tmp_path: Path, monkeypatch):
    path = split(tmp_path / "net.onnx")
    monkeypatch.setattr(vetting, "LARGEST_DATA", 1000)
    refused(path, "its external data 'weights.bin' is larger")


@pytest.mark.parametrize("operator", ["EPContext", "PyOp"])
def test_compiled_code_is_refused(tmp_path: Path, operator: str):
    graph = tiny_graph(TinyNetwork())
    graph.node.append(helper.make_node(operator, ["depth"], ["other"], domain="com.microsoft"))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    helper.set_model_props(model, TinyNetwork().card().to_metadata())
    path = tmp_path / "net.onnx"
    path.write_bytes(model.SerializeToString())
    refused(path, f"contains {operator}, compiled code")


@pytest.mark.parametrize("opset", [0, 4, 99])
def test_an_opset_that_onnxruntime_does_not_have_is_refused_in_one_line(tmp_path: Path, opset: int):
    graph = tiny_graph(TinyNetwork())
    if opset == 4:  # when AveragePool was not what it is now, nothing of it runs
        graph.node.append(helper.make_node("Resize", ["depth"], ["other"]))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    helper.set_model_props(model, TinyNetwork().card().to_metadata())
    path = tmp_path / "net.onnx"
    path.write_bytes(model.SerializeToString())
    with pytest.raises(ModelError, match=rf"opset {opset}") as error:
        OnnxNetwork(path)
    assert "\n" not in str(error.value)


def test_damaged_weights_have_another_digest(tmp_path: Path):
    path = write_tiny_network(tmp_path / "net.onnx")
    digest = sha256_of(path)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(ModelError, match=f"not the registered {digest[:12]}"):
        vet(path, digest)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_damaged_network_runs_or_is_refused_in_one_line(damaged: Path, data: st.DataObject):
    content = bytearray((damaged.parent / "whole.onnx").read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(1, 3))] = data.draw(st.binary(max_size=3))
        content = content or bytearray(1)
    damaged.write_bytes(content)
    try:
        said = OnnxNetwork(damaged).name
    except ModelError as error:
        said = str(error)
    assert "\n" not in said


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a damaged file goes; the sound one lies beside it as whole.onnx."""
    folder = tmp_path_factory.mktemp("damaged")
    write_tiny_network(folder / "whole.onnx", TinyNetwork(confidence=True, descriptor=True))
    return folder / "damaged.onnx"


def test_a_tensor_shorter_than_its_shape_is_refused(tmp_path: Path):
    model = onnx.load(write_tiny_network(tmp_path / "net.onnx"))
    for tensor in model.graph.initializer:
        tensor.CopyFrom(numpy_helper.from_array(np.ones(1, np.float32), tensor.name))
        tensor.dims[:] = [2**20, 2**20]
    model.graph.initializer[0].data_type = TensorProto.FLOAT
    (tmp_path / "net.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(ModelError, match="no ONNX model that onnxruntime") as error:
        OnnxNetwork(tmp_path / "net.onnx")
    assert "\n" not in str(error.value)


def test_a_graph_that_asks_for_a_petabyte_is_refused_in_one_line(tmp_path: Path, capfd):
    side = 2**24
    shape = numpy_helper.from_array(np.array([1, 1, side, side], np.int64), "shape")
    nodes = [
        helper.make_node("ConstantOfShape", ["shape"], ["vast"]),
        helper.make_node("ReduceMean", ["image"], ["mean"], keepdims=1),
        helper.make_node("Add", ["vast", "mean"], ["depth"]),
    ]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 240, 320])
    depth = helper.make_tensor_value_info("depth", TensorProto.FLOAT, [1, 1, side, side])
    path = tmp_path / "net.onnx"
    save(path, helper.make_graph(nodes, "g", [image], [depth], [shape]), TinyNetwork().card())
    says = "first inference failed .ConstantOfShape: Failed to allocate memory|can load .*bad_alloc"
    with pytest.raises(ModelError, match=says) as error:
        OnnxNetwork(path)
    assert "\n" not in str(error.value)
    assert capfd.readouterr().err == ""  # onnxruntime says nothing besides


@pytest.mark.parametrize("name", ["none.onnx", "folder", "nul\x00.onnx", "deep/none.onnx"])
def test_what_is_no_file_is_refused(tmp_path: Path, name: str):
    (tmp_path / "folder").mkdir()
    with pytest.raises(ModelError, match="can't be read") as error:
        vet(tmp_path / name)
    assert "\n" not in str(error.value)


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path):
    os.mkfifo(tmp_path / "net.onnx")
    refused(tmp_path / "net.onnx", "no plain file")
