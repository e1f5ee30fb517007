"""A focal-normalised network that truly measures: depth from how large a known thing appears.

A thing of integrated brightness B (m^2) at depth z sums to S = B fx fy / z^2 over the pixels of an image
with focal lengths fx, fy, whatever they are. Knowing B but no camera, a network can say how far away the
thing would be if the focal length were f0: f0 sqrt(B / S). That is what this one puts out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from prism_edge.depth.contract import FOCAL_NORMALISED, KEPT, ModelCard
from tests.synthetic.network import save

OUT = (24, 32)  # rows, columns of its depth map


def ramp() -> np.ndarray:
    """What its depth map is multiplied by, as a constant map would be taken for a failure."""
    return np.broadcast_to(np.linspace(1.0, 1.2, OUT[1], dtype=np.float32), OUT)


def write_ruler(path: Path, width: int, height: int, f0: float, brightness: float, resize: str) -> Path:
    """Writes the network for inputs of width x height; ``brightness`` is B."""
    card = ModelCard(
        name="ruler",
        revision="1",
        licence="Apache-2.0",
        depth_kind=FOCAL_NORMALISED,
        canonical_focal_length=f0,
        scale_bias_sigma=0.01,
        input_width=width,
        input_height=height,
        levels=KEPT,  # it measures how bright its picture is
        resize=resize,
    )
    per_mean = brightness / (width * height)  # B / S = per_mean / mean
    constants = {
        "numerator": np.array([per_mean * f0 * f0], np.float32),
        "ramp": ramp()[None, None].copy(),
    }
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["mean"], axes=[1, 2, 3], keepdims=1),
        helper.make_node("Div", ["numerator", "mean"], ["squared"]),
        helper.make_node("Sqrt", ["squared"], ["distance"]),
        helper.make_node("Mul", ["distance", "ramp"], ["depth"]),
    ]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, height, width])
    depth = helper.make_tensor_value_info("depth", TensorProto.FLOAT, [1, 1, *OUT])
    tensors = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    save(path, helper.make_graph(nodes, "ruler", [image], [depth], tensors), card)
    return path
