"""Gives a depth network a place descriptor: an inner tensor, pooled to one vector of norm 1, as an output.

    python tools/expose_descriptor.py MODEL.onnx OUT.onnx [--layer TENSOR] [--pooling POOLING]
    python tools/expose_descriptor.py MODEL.onnx --list

Nothing is trained and the depth stays what it was, bit for bit: the written file is run against the
original before it is kept. Without --layer the one that the network's card names is taken; where it names
none, one is chosen: of the encoder's maps the middle one at a sixteenth of the input's size. An input of free
size has the card's size in the written file. Needs the package `onnx` (the extra `dev`). The daemon itself
does the same to a file whose card names a layer but no output (docs/MODELS.md); this tool makes files that
need no such card, for any other use of them.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

try:
    import onnx
    from onnx import NodeProto, TensorProto, helper, numpy_helper
except ImportError:
    sys.exit("expose_descriptor: error: needs onnx; the extra dev has it")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.depth.agreement import depth_output
from prism_edge.depth.cards import card_of
from prism_edge.depth.contract import ModelCard
from prism_edge.depth.inner_tensor import GEM, GEM_FLOOR, GEM_POWER, GRID, MAX, POOLINGS, TOKEN, halves
from prism_edge.depth.providers import ask_for_whole_products
from prism_edge.depth.vetting import vet
from prism_edge.errors import FAILING_FILE, ModelError, PrismError, first_line, in_words

# isort: split
import onnxruntime  # after prism_edge, which keeps it from reporting to its makers

OUTPUT = "place_descriptor"
STRIDE = 16  # input pixels a cell of the preferred map
_LARGEST_MESSAGE = 2**31 - 2**20  # bytes of one protobuf message; beyond, weights go into a file beside it
_LARGEST_CONSTANT = 2**16  # bytes; above, a tensor holds weights
_PASSED_ON = {"BatchNormalization", "Relu", "Clip", "LeakyRelu", "HardSwish", "Gelu", "Identity", "Cast"}
_UPSAMPLING = {"Upsample", "Resize", "ConvTranspose"}


def main(arguments: list[str] | None = None) -> int:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("model", metavar="MODEL.onnx", type=Path)
    parser.add_argument("out", metavar="OUT.onnx", type=Path, nargs="?")
    parser.add_argument("--layer", metavar="TENSOR", help="a map (1, C, h, w) or tokens (1, n, C)")
    parser.add_argument("--pooling", choices=POOLINGS, help="default: the card's; grid for a map, else token")
    parser.add_argument("--list", action="store_true", help="show the tensors that can be pooled, and stop")
    args = parser.parse_args(arguments)
    if not args.list and args.out is None:
        parser.error("OUT.onnx is needed")
    try:
        model, card = read(args.model)
        if args.list:
            for name, shape in poolable(model).items():
                print(f"{name}  {list(shape)}")
            return 0
        layer, pooling = chosen(model, card, args.layer, args.pooling)
        write(args.model, model, card, layer, pooling, args.out)
    except (PrismError, OSError) as error:
        print(f"expose_descriptor: error: {in_words(error)}", file=sys.stderr)
        return error.exit_code if isinstance(error, PrismError) else FAILING_FILE
    print(f"{args.out}: {OUTPUT} is {pooling} of {layer}; depth is unchanged bit for bit")
    return 0


def read(path: Path) -> tuple[onnx.ModelProto, ModelCard]:
    """The model with its weights, and its card. Raises ModelError where the file is none or has no card."""
    vetted = vet(path)
    try:
        model = onnx.load(str(path))
    except Exception as error:  # protobuf's, onnx's and the file system's, without a common root
        raise ModelError(f"{path}: no ONNX model ({first_line(error, 100)})") from None
    card = card_of(path, vetted)
    _fix_input(model, card)
    return model, card


def _fix_input(model: onnx.ModelProto, card: ModelCard) -> None:
    """Gives free dimensions of the input their size by the card, else no inner shape would follow."""
    weights = {tensor.name for tensor in model.graph.initializer}
    for value in model.graph.input:
        if value.name == card.input_name or (not card.input_name and value.name not in weights):
            sizes = (1, 3, card.input_height, card.input_width)
            for dim, size in zip(value.type.tensor_type.shape.dim, sizes, strict=False):
                if dim.dim_value < 1:
                    dim.dim_value = size


def poolable(model: onnx.ModelProto) -> dict[str, tuple[int, ...]]:
    """Tensors that can be pooled, outputs too, with their shapes: maps (1, C, h, w), tokens (1, n, C)."""
    shapes = {}
    with _without_weights(model):
        inferred = onnx.shape_inference.infer_shapes(model).graph
    for value in (*inferred.value_info, *inferred.output):
        kind = value.type.tensor_type
        shape = tuple(dim.dim_value for dim in kind.shape.dim)
        is_float = kind.elem_type in (TensorProto.FLOAT, TensorProto.FLOAT16)
        if is_float and len(shape) in (3, 4) and shape[0] == 1 and min(shape) >= 1:
            shapes[value.name] = shape
    return shapes


@contextmanager
def _without_weights(model: onnx.ModelProto) -> Iterator[None]:
    """Shapes follow from small constants, and a model of gigabytes can't be handed to onnx as a whole."""
    large = [tensor for tensor in model.graph.initializer if len(tensor.raw_data) > _LARGEST_CONSTANT]
    weights = [tensor.raw_data for tensor in large]
    try:
        for tensor in large:
            tensor.ClearField("raw_data")
        yield
    finally:
        for tensor, data in zip(large, weights, strict=True):
            tensor.raw_data = data


def chosen(
    model: onnx.ModelProto, card: ModelCard, layer: str | None, pooling: str | None
) -> tuple[str, str]:
    """The layer and the pooling to take. Raises ModelError where the network has no such tensor."""
    shapes = poolable(model)
    if not layer:
        layer, pooling = card.descriptor_layer, pooling or card.descriptor_pooling
    if not layer:
        layer = middle_of_the_encoder(model, card.input_height)
    if layer not in shapes:
        whose = " that its card names" if layer == card.descriptor_layer else ""
        raise ModelError(
            f"{card.name}: has no tensor {layer!r}{whose} to be pooled (--list shows those it has, --layer "
            "names one)"
        )
    pooling = pooling or (GRID if len(shapes[layer]) == 4 else TOKEN)
    if (pooling == GRID and len(shapes[layer]) == 3) or (pooling == TOKEN and len(shapes[layer]) == 4):
        raise ModelError(f"{card.name}: pooling {pooling} does not go with {layer} {list(shapes[layer])}")
    return layer, pooling


def middle_of_the_encoder(model: onnx.ModelProto, input_height: int) -> str:
    """Of the maps before any upsampling, whose size is nearest a sixteenth of the input's, the middle one.

    Early maps know edges, the last ones what depth needs; places show best in between, where there still
    is a layout (measured: docs/MODELS.md). Raises ModelError where the graph has no such map.
    """
    shapes, graph = poolable(model), model.graph
    consumers: dict[str, list[str]] = {}
    for node in graph.node:
        for name in node.input:
            consumers.setdefault(name, []).append(node.op_type)
    upsampled: set[str] = set()
    encoder = []
    for node in graph.node:
        if node.op_type in _UPSAMPLING or any(name in upsampled for name in node.input):
            upsampled.update(node.output)
            continue
        for name in node.output:
            passed_on = len(consumers.get(name, [])) == 1 and consumers[name][0] in _PASSED_ON
            if len(shapes.get(name, ())) == 4 and min(shapes[name][2:]) >= 4 and not passed_on:
                encoder.append(name)
    if not encoder:
        raise ModelError("no inner map (1, C, h, w) of fixed shape was found: name a tensor with --layer")
    size = input_height / STRIDE
    distance = {name: abs(np.log(shapes[name][2] / size)) for name in encoder}
    at_size = [name for name in encoder if distance[name] <= min(distance.values()) + 1e-9]
    most = max(shapes[name][1] for name in at_size)
    wide = [name for name in at_size if 2 * shapes[name][1] >= most]
    return wide[len(wide) // 2]


def write(
    source: Path, model: onnx.ModelProto, card: ModelCard, layer: str, pooling: str, out: Path
) -> ModelCard:
    """Writes ``model`` with the descriptor to ``out`` and returns its card; what fails changes nothing there.

    Raises ModelError where the result's depth is not the original's, or its descriptor has no norm.
    """
    if out.resolve() == source.resolve():
        raise ModelError(f"{out}: is the model itself; name another file")
    taken = {name for node in model.graph.node for name in node.output}
    if OUTPUT in taken:
        raise ModelError(f"{source.name}: has an output {OUTPUT!r} already")
    depth = depth_output(card, [output.name for output in model.graph.output], layer, source.name)
    shape = poolable(model)[layer]
    opset = max(item.version for item in model.opset_import if item.domain in ("", "ai.onnx"))
    model.graph.node.extend(pooling_nodes(layer, shape, pooling, opset))
    length = (shape[2] if len(shape) == 3 else shape[1]) * (4 if pooling == GRID else 1)
    model.graph.output.append(helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, [1, length]))
    exposed = replace(
        card,
        name=f"{card.name[:57]}_places",
        sha256="",
        depth_output=depth,
        descriptor_output=OUTPUT,
        descriptor_layer=layer,
        descriptor_pooling=pooling,
    )
    helper.set_model_props(model, exposed.to_metadata())
    weights = out.with_name(out.name + ".data")
    # Tensor by tensor: a message that is too large can't even be measured.
    external = sum(tensor.ByteSize() for tensor in model.graph.initializer) > _LARGEST_MESSAGE
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        made = Path(folder) / out.name
        onnx.save(model, str(made), save_as_external_data=external, location=weights.name)
        _compare(source, made, exposed)
        if external:
            made.with_name(weights.name).chmod(made.stat().st_mode)  # they are written for their owner alone
            shutil.move(made.with_name(weights.name), weights)
        shutil.move(made, out)  # the graph last: it is what is looked for
    return exposed


def pooling_nodes(layer: str, shape: tuple[int, ...], pooling: str, opset: int) -> Iterator[NodeProto]:
    """The operators from ``layer`` to OUTPUT (1, n): what inner_tensor.pool computes, in any opset from 7.

    Constants are nodes, as initialisers of old files must be inputs too.
    """
    yield helper.make_node("Cast", [layer], ["place_values"], to=TensorProto.FLOAT)
    if pooling == TOKEN:
        yield from _slice("place_values", "place_pooled", (1,), (0,), (1,), opset)
    elif pooling == GRID:
        parts = [(rows, columns) for rows in halves(shape[2]) for columns in halves(shape[3])]
        for i, (rows, columns) in enumerate(parts):
            starts, ends = (rows.start, columns.start), (rows.stop, columns.stop)
            yield from _slice("place_values", f"place_quarter_{i}", (2, 3), starts, ends, opset)
            yield helper.make_node("GlobalAveragePool", [f"place_quarter_{i}"], [f"place_mean_{i}"])
        means = [f"place_mean_{i}" for i in range(len(parts))]
        yield helper.make_node("Concat", means, ["place_pooled"], axis=1)
    else:
        places = "place_values"
        if len(shape) == 3:
            yield helper.make_node("Transpose", [places], ["place_columns"], perm=[0, 2, 1])
            places = "place_columns"
        yield from _over_all(places, pooling)
    yield helper.make_node("Flatten", ["place_pooled"], ["place_vector"], axis=1)
    yield helper.make_node("LpNormalization", ["place_vector"], [OUTPUT], axis=1, p=2)


def _over_all(places: str, pooling: str) -> Iterator[NodeProto]:
    if pooling != GEM:
        yield helper.make_node(
            "GlobalMaxPool" if pooling == MAX else "GlobalAveragePool", [places], ["place_pooled"]
        )
        return
    for name, value in (("floor", GEM_FLOOR), ("power", GEM_POWER), ("root", 1.0 / GEM_POWER)):
        yield _constant(f"place_{name}", np.array([value], np.float32))
    yield helper.make_node("Relu", [places], ["place_positive"])
    yield helper.make_node("Add", ["place_positive", "place_floor"], ["place_floored"])
    yield helper.make_node("Pow", ["place_floored", "place_power"], ["place_powers"])
    yield helper.make_node("GlobalAveragePool", ["place_powers"], ["place_mean_power"])
    yield helper.make_node("Pow", ["place_mean_power", "place_root"], ["place_pooled"])


def _slice(
    source: str, out: str, axes: tuple[int, ...], starts: tuple[int, ...], ends: tuple[int, ...], opset: int
) -> Iterator[NodeProto]:
    bounds: dict[str, Any] = {"starts": starts, "ends": ends, "axes": axes}
    if opset < 10:  # bounds were attributes then
        yield helper.make_node("Slice", [source], [out], **bounds)
        return
    for key, values in bounds.items():
        yield _constant(f"{out}_{key}", np.array(values, np.int64))
    yield helper.make_node("Slice", [source, *(f"{out}_{key}" for key in bounds)], [out])


def _constant(name: str, value: np.ndarray) -> NodeProto:
    return helper.make_node("Constant", [], [name], value=numpy_helper.from_array(value, name))


def _compare(source: Path, out: Path, card: ModelCard) -> None:
    """Runs both files on one noise image. Raises ModelError unless they agree."""
    image = np.random.default_rng(0).normal(size=(1, 3, card.input_height, card.input_width))
    answers = []
    for path, outputs in ((source, [card.depth_output]), (out, [card.depth_output, OUTPUT])):
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4
        ask_for_whole_products(options)
        try:
            session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
            name = card.input_name or session.get_inputs()[0].name
            answers.append(session.run(outputs, {name: image.astype(np.float32)}))
        except Exception as error:  # onnxruntime's exceptions have no common root
            raise ModelError(f"{path.name}: does not run ({first_line(error, 100)})") from None
    if not np.array_equal(answers[0][0], answers[1][0], equal_nan=True):
        raise ModelError(f"{out.name}: its depth would not be that of {source.name}; choose another layer")
    norm = float(np.linalg.norm(answers[1][1]))
    if not abs(norm - 1.0) < 1e-3:
        raise ModelError(f"{out.name}: descriptor of norm {norm:.3g}; choose another layer")


if __name__ == "__main__":
    sys.exit(main())
