"""From a PyTorch network to an ONNX file: fp32 first, the other precisions from that."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from pathlib import Path

import onnx
import onnxruntime
import torch
from onnx import helper
from torch import Tensor, nn

from prism_edge.depth.contract import ModelCard
from prism_edge.errors import ModelError, first_line
from tools.export_da3.fixed_size import recorded

OPSET = 17  # the first with LayerNormalization
FP32, FP16, INT8 = "fp32", "fp16", "int8"
PRECISIONS = (FP32, FP16, INT8)
_LARGEST_MESSAGE = 2**31 - 2**24  # bytes; beyond, weights go into a file of their own
# What loses too much in half precision (sums over many values, exponentials), or has no such operator.
_KEPT_FP32 = ("LayerNormalization", "Softmax", "Exp", "ReduceSum", "ReduceMean", "Sqrt", "TopK", "Resize")
NESTED_PART = "alignment"  # of a nested graph: squares of depths and sums over all pixels stay fp32


def trace(network: nn.Module, example: Sequence[Tensor], inputs: Sequence[str], path: Path) -> Path:
    """Writes ``network`` as it is at the example's size to ``path``; everything fixed by the size folded.

    Raises ModelError where the exporter or onnxruntime refuses it.
    """
    raw = path.with_name(path.stem + "_traced.onnx")
    try:
        with warnings.catch_warnings(), torch.no_grad(), recorded():
            warnings.simplefilter("ignore")  # the exporter's, about sizes that are meant to be fixed
            network(*example)
            torch.onnx.export(
                network,
                tuple(example),
                str(raw),
                input_names=list(inputs),
                output_names=list(network.output_names),  # type: ignore[arg-type]
                opset_version=OPSET,
                dynamo=False,
            )
        fold(raw, path)
        remove(raw)
    except OSError:
        raise
    except Exception as error:  # torch's and onnxruntime's, without a common root
        raise ModelError(f"{path.name}: can't be exported ({first_line(error, 150)})") from None
    return path


def fold(source: Path, out: Path) -> None:
    """onnxruntime's basic optimisation, which keeps to standard operators: constants folded, no-ops gone."""
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.optimized_model_filepath = str(out)
    options.log_severity_level = 3
    if weight_bytes(source) > _LARGEST_MESSAGE:
        options.add_session_config_entry(
            "session.optimized_model_external_initializers_file_name", weights_of(out).name
        )
    onnxruntime.InferenceSession(str(source), options, providers=["CPUExecutionProvider"])


def in_precision(source: Path, precision: str) -> onnx.ModelProto:
    """The network of the fp32 file ``source`` in one of PRECISIONS. Raises ModelError, OSError."""
    try:
        return _in_precision(source, precision)
    except OSError:
        raise
    except Exception as error:  # onnx's, onnxruntime's and protobuf's: of a file cut off by a full disk, too
        why = first_line(error, 150)
        raise ModelError(f"{source.name}: {precision} can't be made of it ({why})") from None


def _in_precision(source: Path, precision: str) -> onnx.ModelProto:
    if precision == FP16:
        # Types of all tensors, by way of a file: in memory it is limited to what one message can hold.
        typed = source.with_name("typed.onnx")
        onnx.shape_inference.infer_shapes_path(str(source), str(typed))
        return _half(onnx.load(str(typed)))
    if precision == INT8:
        return _quantised(source, source.with_name("quantised.onnx"))
    return onnx.load(str(source))


def _half(model: onnx.ModelProto) -> onnx.ModelProto:
    """In half precision, but for the operators that need more; inputs and outputs stay fp32.

    ``model`` carries the types of its tensors.
    """
    from onnxruntime.transformers.float16 import convert_float_to_float16

    for number, node in enumerate(model.graph.node):  # folding left some without a name of their own
        node.name = f"{node.name}_{number}"
    kept_nodes = [node.name for node in model.graph.node if f"/{NESTED_PART}/" in node.name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # weights below fp16's range, rounded to its least
        converted = convert_float_to_float16(
            model,
            keep_io_types=True,
            op_block_list=list(_KEPT_FP32),
            node_block_list=kept_nodes,
            disable_shape_infer=True,
        )
    return _without_repeated_casts(converted)


def _without_repeated_casts(model: onnx.ModelProto) -> onnx.ModelProto:
    """One cast of each tensor: the converter writes one for each user, all under one name."""
    from onnxruntime.transformers.onnx_model import OnnxModel

    known: set[str] = set()
    nodes = []
    for node in model.graph.node:
        if node.op_type == "Cast" and node.output[0] in known:
            continue
        known.update(node.output)
        nodes.append(node)
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    ordered = OnnxModel(model)
    ordered.topological_sort()
    return ordered.model


def _quantised(source: Path, scratch: Path) -> onnx.ModelProto:
    """The fp32 file ``source`` with its matrix products in int8: weights by channel, and activations.

    Convolutions stay fp32: they are few, and the depth head's last ones are what its detail rests on.
    """
    from onnxruntime.quantization import QuantType, quantize_dynamic

    level = logging.getLogger().level
    logging.getLogger().setLevel(logging.ERROR)  # it advises a step that folding has done
    try:
        quantize_dynamic(
            str(source),
            str(scratch),
            op_types_to_quantize=["MatMul", "Gemm"],
            per_channel=True,
            weight_type=QuantType.QInt8,
            use_external_data_format=weight_bytes(source) // 3 > _LARGEST_MESSAGE,
            extra_options={"MatMulConstBOnly": True},  # attention's own products stay fp32
        )
    finally:
        logging.getLogger().setLevel(level)
    return onnx.load(str(scratch))


def save(model: onnx.ModelProto, card: ModelCard, path: Path, external: bool = False) -> None:
    """Writes one file that carries its card; the weights beside it if ``external``, or if they must be."""
    helper.set_model_props(model, card.to_metadata())
    model.producer_name, model.producer_version = "prism_edge export_da3", "1"
    external = external or _weights_in(model) > _LARGEST_MESSAGE
    onnx.save(model, str(path), save_as_external_data=external, location=weights_of(path).name)


def weights_of(path: Path) -> Path:
    """Where a file's weights are if they are not in it."""
    return path.with_name(path.name + ".data")


def remove(path: Path) -> None:
    """The file and its weights."""
    for file in (path, weights_of(path)):
        file.unlink(missing_ok=True)


def _weights_in(model: onnx.ModelProto) -> int:
    """Bytes of the weights; ByteSize itself fails beyond what a message can hold."""
    return sum(len(tensor.raw_data) for tensor in model.graph.initializer)


def weight_bytes(path: Path) -> int:
    """Bytes of a graph with its weights, wherever they are: the exporter puts large ones in many files."""
    model = onnx.load(str(path), load_external_data=False)
    total = path.stat().st_size
    for tensor in model.graph.initializer:
        total += sum(int(entry.value) for entry in tensor.external_data if entry.key == "length")
    return total
