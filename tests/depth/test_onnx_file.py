"""The walk over an ONNX file's fields, judged by the package `onnx` and by damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from prism_edge.depth.onnx_file import LONGEST_TEXT, External, Outline, read_outline
from prism_edge.depth.session import OnnxNetwork
from prism_edge.errors import ModelError
from tests.synthetic.network import TinyNetwork, write_tiny_network


def outline_of(model: onnx.ModelProto):
    return read_outline(memoryview(model.SerializeToString()), "net.onnx")


def external(name: str, location: str, **more: str) -> TensorProto:
    tensor = TensorProto(name=name, data_type=TensorProto.FLOAT, dims=[2])
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in {"location": location, **more}.items():
        tensor.external_data.add(key=key, value=value)
    return tensor


def model_of(nodes=(), initializers=(), **more) -> onnx.ModelProto:
    out = helper.make_tensor_value_info("out", TensorProto.FLOAT, [2])
    graph = helper.make_graph(list(nodes), "g", [], [out], list(initializers))
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9, **more)


def test_what_a_file_says_of_itself_is_read_as_onnx_reads_it(tmp_path: Path):
    path = write_tiny_network(tmp_path / "net.onnx", TinyNetwork(confidence=True, descriptor=True))
    outline = read_outline(memoryview(path.read_bytes()), "net.onnx")
    truth = onnx.load(path)
    assert outline.opsets == {item.domain: item.version for item in truth.opset_import}
    assert outline.metadata == {item.key: item.value for item in truth.metadata_props}
    assert outline.operators == {node.op_type for node in truth.graph.node}
    assert outline.external == []


@pytest.mark.realdata
def test_real_files_are_read_as_onnx_reads_them(shared: Path):
    files = sorted((shared / "models").glob("*.onnx"))
    assert files
    for path in files:
        outline = read_outline(memoryview(path.read_bytes()), path.name)
        truth = onnx.load(path)
        assert outline.opsets == {item.domain: item.version for item in truth.opset_import}
        assert outline.operators >= {node.op_type for node in truth.graph.node}
        assert outline.metadata == {item.key: item.value for item in truth.metadata_props}


def branch(name: str, tensor: TensorProto) -> onnx.GraphProto:
    out = helper.make_tensor_value_info(tensor.name, TensorProto.FLOAT, [2])
    return helper.make_graph([], name, [], [out], [tensor])


def places() -> dict[str, onnx.ModelProto]:
    """A model for each place where a tensor can lie in a file, with one of external data there."""
    constant = helper.make_node("Constant", [], ["out"])
    constant.attribute.append(helper.make_attribute("value", external("t", "w.bin")))
    listed = helper.make_node("Thing", [], ["out"])
    listed.attribute.append(helper.make_attribute("many", [external("t", "w.bin")]))
    plain = numpy_helper.from_array(np.ones(2, np.float32), "plain")
    inner = branch("then", external("t", "w.bin"))
    either = helper.make_node("If", ["c"], ["out"], then_branch=inner, else_branch=branch("else", plain))
    deeper = helper.make_node(
        "If",
        ["c"],
        ["out"],
        then_branch=helper.make_graph([either], "outer", [], []),
        else_branch=branch("else", plain),
    )
    sparse = model_of()
    entry = sparse.graph.sparse_initializer.add(dims=[9])
    entry.values.CopyFrom(external("t", "w.bin"))
    function = helper.make_function("mine", "F", [], ["out"], [constant], [helper.make_opsetid("", 17)])
    passed_on = helper.make_node("Constant", [], ["out"])
    passed_on.attribute.add(name="value", ref_attr_name="value", type=onnx.AttributeProto.TENSOR)
    default = helper.make_attribute("value", external("t", "w.bin"))
    of_defaults = helper.make_function(
        "mine", "F", [], ["out"], [passed_on], [helper.make_opsetid("", 17)], attribute_protos=[default]
    )
    unmarked = external("t", "w.bin")
    unmarked.ClearField("data_location")
    return {
        "initializer": model_of(initializers=[external("t", "w.bin")]),
        "constant": model_of([constant]),
        "list": model_of([listed]),
        "branch": model_of([either]),
        "branch of a branch": model_of([deeper]),
        "sparse": sparse,
        "function": model_of(functions=[function]),
        "function's default": model_of(functions=[of_defaults]),
        "not marked as external": model_of(initializers=[unmarked]),
    }


@pytest.mark.parametrize("place", places())
def test_external_data_is_found_wherever_a_tensor_can_be(place: str):
    assert outline_of(places()[place]).external == [External("w.bin", 0, 0)]


def test_there_is_no_other_place_for_a_tensor_in_a_file():
    """Every field of every message, by onnx's own schema, through which a tensor can be reached."""
    messages, todo = {}, [onnx.ModelProto.DESCRIPTOR]
    while todo:
        message = todo.pop()
        messages[message.name] = [field for field in message.fields if field.message_type]
        todo += [f.message_type for f in messages[message.name] if f.message_type.name not in messages]
    holding: set[str] = set()
    found = {"TensorProto"}
    while found != holding:
        holding = found
        found = holding | {
            name for name, held in messages.items() if any(f.message_type.name in holding for f in held)
        }
    ways = {
        f"{name}.{f.name}" for name, held in messages.items() for f in held if f.message_type.name in holding
    }
    refused = {"ModelProto.training_info", "TrainingInfoProto.initialization", "TrainingInfoProto.algorithm"}
    assert ways - refused == {
        *("ModelProto.graph", "ModelProto.functions", "FunctionProto.node", "FunctionProto.attribute_proto"),
        *("GraphProto.node", "GraphProto.initializer", "GraphProto.sparse_initializer"),
        *("NodeProto.attribute", "AttributeProto.t", "AttributeProto.tensors"),
        *("AttributeProto.g", "AttributeProto.graphs"),
        *("AttributeProto.sparse_tensor", "AttributeProto.sparse_tensors"),
        *("SparseTensorProto.values", "SparseTensorProto.indices"),
    }  # those that read_outline walks, and places() has a model of


def test_where_external_data_lies_is_read():
    tensor = external("t", "a/b.bin", offset="4096", length="8")
    assert outline_of(model_of(initializers=[tensor])).external == [External("a/b.bin", 4096, 8)]


def twice() -> onnx.ModelProto:
    tensor = external("t", "good.bin")
    tensor.external_data.add(key="location", value="/etc/passwd")
    return model_of(initializers=[tensor])


def nested(times: int) -> onnx.ModelProto:
    graph = helper.make_graph([], "innermost", [], [])
    for _ in range(times):
        graph = helper.make_graph([helper.make_node("If", ["c"], ["o"], then_branch=graph)], "g", [], [])
    return helper.make_model(graph)


@pytest.mark.parametrize(
    ("model", "says"),
    [
        (twice(), "says its location twice"),
        (nested(24), "nested more than 16 deep"),
        (model_of(initializers=[external("t", "w", offset="-1")]), "offset or length of '-1'"),
        (model_of(initializers=[external("t", "w", length="9" * 30)]), "offset or length"),
        (model_of(initializers=[external("t", "w", offset="٣")]), "offset or length"),
        (onnx.ModelProto(ir_version=9), "no graph"),
    ],
)
def test_what_no_honest_file_has_is_refused(model: onnx.ModelProto, says: str):
    with pytest.raises(ModelError, match=says) as error:
        outline_of(model)
    assert str(error.value).startswith("net.onnx: no ONNX model, or damaged")
    assert "\n" not in str(error.value)


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


@pytest.mark.parametrize("tag", [0 << 3, (1 << 32) + (7 << 3 | 2), (7 << 3) | 3, (1 << 35) | (7 << 3 | 2)])
def test_a_tag_that_readers_take_differently_is_refused(tag: int):
    graph = model_of(initializers=[external("t", "/etc/passwd")]).graph.SerializeToString()
    content = model_of().SerializeToString() + varint(tag) + varint(len(graph)) + graph
    with pytest.raises(ModelError, match="a field"):
        read_outline(memoryview(content), "net.onnx")


def test_a_graph_in_two_parts_is_walked_in_both():
    first, second = model_of(), model_of(initializers=[external("t", "w.bin")])
    content = first.SerializeToString() + second.SerializeToString()  # readers merge them
    assert onnx.ModelProto.FromString(content).graph.initializer[0].name == "t"
    assert read_outline(memoryview(content), "net.onnx").external == [External("w.bin", 0, 0)]


def test_a_training_graph_is_refused():
    model = model_of()
    model.training_info.add()
    with pytest.raises(ModelError, match="training graph"):
        outline_of(model)


def tiny_bytes(folder: Path) -> bytes:
    return write_tiny_network(folder / "tiny.onnx", TinyNetwork(descriptor=True)).read_bytes()


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return tiny_bytes(tmp_path_factory.mktemp("tiny"))


def attempt(content: bytes) -> tuple[Outline | None, str]:
    """The outline, or the error's text; any other exception is a failure of the test."""
    try:
        return read_outline(memoryview(content), "net.onnx"), ""
    except ModelError as error:
        return None, str(error)


def test_a_file_cut_anywhere_but_between_its_fields_is_refused(tiny: bytes):
    whole = onnx.ModelProto.FromString(tiny)
    refused = 0
    for end in range(0, len(tiny), 7):
        outline, line = attempt(tiny[:end])
        refused += outline is None
        assert "\n" not in line
        if outline is not None:  # cut between two fields of the model itself: what came before is whole
            assert outline.operators == {node.op_type for node in whole.graph.node}
    assert refused > 0.9 * len(range(0, len(tiny), 7))


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_any_damage_is_a_model_error_or_an_outline(tiny: bytes, data: st.DataObject):
    spoilt = bytearray(tiny)
    for _ in range(data.draw(st.integers(1, 6))):
        spoilt[data.draw(st.integers(0, len(spoilt) - 1))] = data.draw(st.integers(0, 255))
    assert "\n" not in attempt(bytes(spoilt))[1]


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_are_a_model_error_or_an_outline(content: bytes):
    assert "\n" not in attempt(content)[1]


def test_metadata_longer_than_any_card_is_passed_over(tmp_path: Path):
    path = write_tiny_network(tmp_path / "net.onnx")
    model = onnx.load(path)
    for key, length in (("training_config", LONGEST_TEXT + 1), ("short", LONGEST_TEXT)):
        entry = model.metadata_props.add()
        entry.key, entry.value = key, "x" * length
    outline = read_outline(memoryview(model.SerializeToString()), "net.onnx")
    assert "training_config" not in outline.metadata
    assert {"short", "prism_edge.name"} <= set(outline.metadata)


def test_a_card_s_key_that_metadata_say_twice_is_refused_and_another_s_is_not(tmp_path: Path):
    """Of two scales the last would count, and nobody would know."""
    path = write_tiny_network(tmp_path / "net.onnx")
    model = onnx.load(path)
    for value in ("3.0", "2.0"):
        model.metadata_props.add(key="note", value=value)
    onnx.save(model, path)
    OnnxNetwork(path)
    for value in ("3.0", "2.0"):
        model.metadata_props.add(key="prism_edge.depth_scale", value=value)
    onnx.save(model, path)
    with pytest.raises(ModelError, match=r"prism_edge\.depth_scale twice"):
        OnnxNetwork(path)
