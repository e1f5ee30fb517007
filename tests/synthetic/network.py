"""A tiny ONNX network that really maps image to depth: it reads the tint that the generator put there."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import onnx
import yaml
from onnx import TensorProto, helper, numpy_helper

from prism_edge.depth.contract import FOCAL_NORMALISED, INVERSE_RELATIVE, KEPT, METRIC, ModelCard
from tests.synthetic.sequence import synthetic_camera
from tests.synthetic.tint import log_depth_weights

WIDTH, HEIGHT = 320, 240  # of its input
POOL = 4  # its depth map is that much smaller
BIAS_SIGMA = 0.05
MISBEHAVIOURS = ("", "nan", "zero", "negative", "constant", "half_nan")


@dataclass(frozen=True)
class TinyNetwork:
    """What to write. ``gain`` multiplies its depth; ``misbehaviour`` is one of MISBEHAVIOURS."""

    name: str = "tiny_tint"
    depth_kind: str = METRIC
    width: int = WIDTH
    height: int = HEIGHT
    gain: float = 1.0
    misbehaviour: str = ""
    confidence: bool = False
    descriptor: bool = False
    describes_itself: bool = True

    @property
    def canonical_focal_length(self) -> float | None:
        """Of a focal_normalised one: that of the generated sequence's camera at the network's input."""
        if self.depth_kind != FOCAL_NORMALISED:
            return None
        camera = synthetic_camera(self.width, self.height)
        return float(np.sqrt(camera.fx * camera.fy))

    def card(self) -> ModelCard:
        """Its model card, which is true."""
        return ModelCard(
            name=self.name,
            revision="1",
            licence="Apache-2.0",
            source="made by the project's tests",
            depth_kind=self.depth_kind,
            input_width=self.width,
            input_height=self.height,
            input_name="image",
            levels=KEPT,  # its depth is in the tint, however pale that is
            depth_output="depth",
            confidence_output="confidence" if self.confidence else "",
            descriptor_output="descriptor" if self.descriptor else "",
            canonical_focal_length=self.canonical_focal_length,
            scale_bias_sigma=BIAS_SIGMA if self.depth_kind in (METRIC, FOCAL_NORMALISED) else None,
        )


def write_tiny_network(path: Path, what: TinyNetwork | None = None) -> Path:
    """Writes the network to ``path`` and returns it."""
    what = what or TinyNetwork()
    save(path, tiny_graph(what), what.card() if what.describes_itself else None)
    return path


def tiny_graph(what: TinyNetwork) -> onnx.GraphProto:
    """Mean over 4 x 4 pixels, weighted sum of R, G, B, exp."""
    if what.misbehaviour not in MISBEHAVIOURS:
        raise ValueError(f"{what.misbehaviour!r} is none of {MISBEHAVIOURS}")
    weights, offset = log_depth_weights()
    sign = -1.0 if what.depth_kind == INVERSE_RELATIVE else 1.0
    constants = {
        "weights": (sign * weights).reshape(1, 3, 1, 1).astype(np.float32),
        "offset": np.array([sign * offset + np.log(what.gain)], np.float32),
    }
    pooled = {"kernel_shape": [POOL, POOL], "strides": [POOL, POOL]}
    nodes = [
        helper.make_node("AveragePool", ["image"], ["small"], **pooled),
        helper.make_node("Conv", ["small", "weights", "offset"], ["log_depth"]),
        helper.make_node("Exp", ["log_depth"], ["clean"]),
        *_spoiling(what, constants),
    ]
    h, w = what.height // POOL, what.width // POOL
    outputs = [helper.make_tensor_value_info("depth", TensorProto.FLOAT, [1, 1, h, w])]
    if what.confidence:
        nodes.append(helper.make_node("Sigmoid", ["log_depth"], ["certainty"]))
        nodes.append(helper.make_node("Add", ["certainty", "one"], ["confidence"]))
        constants["one"] = np.ones(1, np.float32)
        outputs.append(helper.make_tensor_value_info("confidence", TensorProto.FLOAT, [1, 1, h, w]))
    if what.descriptor:
        grid = {"kernel_shape": [h // 5, w // 5], "strides": [h // 5, w // 5]}
        nodes.append(helper.make_node("AveragePool", ["small"], ["blurred"], **grid))
        nodes.append(helper.make_node("Flatten", ["blurred"], ["descriptor"]))
        outputs.append(helper.make_tensor_value_info("descriptor", TensorProto.FLOAT, [1, None]))
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, what.height, what.width])
    tensors = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    return helper.make_graph(nodes, what.name, [image], outputs, tensors)


def write_sidecar(path: Path, card: ModelCard) -> Path:
    """Describes the network file ``path`` in a YAML file beside it; returns that."""
    values = {key: value for key, value in asdict(card).items() if value not in (None, "")}
    values = {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}
    sidecar = path.with_name(path.name + ".yaml")
    sidecar.write_text(yaml.safe_dump({"contract": 1, **values}), encoding="utf-8")
    return sidecar


def save(path: Path, graph: onnx.GraphProto, card: ModelCard | None) -> None:
    """Writes a graph as an ONNX file, with ``card`` in its metadata where one is given."""
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    if card is not None:
        helper.set_model_props(model, card.to_metadata())
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def two_outputs() -> tuple[onnx.GraphProto, ModelCard]:
    """A network whose second output repeats its depth, and its card."""
    what = TinyNetwork()
    graph = tiny_graph(what)
    graph.node.append(helper.make_node("Identity", ["depth"], ["other"]))
    graph.output.append(helper.make_tensor_value_info("other", TensorProto.FLOAT, [1, 1, 60, 80]))
    return graph, what.card()


def _spoiling(what: TinyNetwork, constants: dict[str, np.ndarray]) -> list[onnx.NodeProto]:
    """The last operators: depth as it should be, or spoilt."""
    shape = (1, 1, what.height // POOL, what.width // POOL)
    factor, addend = np.ones(shape, np.float32), np.zeros(shape, np.float32)
    if what.misbehaviour == "nan":
        addend[:] = np.nan
    elif what.misbehaviour == "half_nan":
        addend[..., : shape[3] // 2] = np.nan
    elif what.misbehaviour == "negative":
        factor[:] = -1.0
    elif what.misbehaviour in ("zero", "constant"):
        factor[:] = 0.0
        addend[:] = 2.0 if what.misbehaviour == "constant" else 0.0
    constants["factor"], constants["addend"] = factor, addend
    return [
        helper.make_node("Mul", ["clean", "factor"], ["scaled"]),
        helper.make_node("Add", ["scaled", "addend"], ["depth"]),
    ]
