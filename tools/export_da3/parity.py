"""Whether an exported file says what PyTorch says, on real images, output by output."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from depth_anything_3.model.da3 import DepthAnything3Net
from numpy.typing import NDArray
from torch import Tensor

from prism_edge.depth.inner_tensor import TOKEN, pool
from prism_edge.depth.providers import ask_for_whole_products
from prism_edge.errors import ModelError, first_line
from tools.export_da3.convert import FP16, FP32, INT8
from tools.export_da3.nested import SKY_LIMIT
from tools.export_da3.networks import HALF_PIXEL, PATCH, Wanted

Outputs = dict[str, NDArray[np.float32]]

# Largest error of any value (fp32, fp16), mean error of an output's values (int8); see error_of.
BOUNDS = {FP32: 1e-4, FP16: 2e-2, INT8: 5e-2}


@dataclass(frozen=True)
class Parity:
    """One output's errors over all images."""

    output: str
    largest: float
    mean: float


def error_of(values: NDArray[np.float32], truth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Relative errors: against the true value, or the output's mean magnitude where that is larger.

    So a depth or a confidence is compared with itself, and a ray's component that happens to be 0 with the
    size that such components have.
    """
    exact = truth.astype(np.float64)
    scale = np.maximum(np.abs(exact), np.mean(np.abs(exact)))
    return np.abs(values.astype(np.float64) - exact) / np.maximum(scale, 1e-12)


def compare(
    path: Path, inputs: Sequence[Mapping[str, NDArray[np.float32]]], truths: Sequence[Outputs]
) -> list[Parity]:
    """Runs the file on each of ``inputs``. Raises ModelError where it doesn't run or a shape is another."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    ask_for_whole_products(options)  # as the daemon will run it
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        names = [output.name for output in session.get_outputs()]
        answers = [dict(zip(names, session.run(names, dict(feed)), strict=True)) for feed in inputs]
    except Exception as error:  # onnxruntime's exceptions have no common root of their own
        raise ModelError(f"{path.name}: does not run ({first_line(error, 150)})") from None
    parities = []
    for name in names:
        errors = []
        for answer, truth in zip(answers, truths, strict=True):
            if answer[name].shape != truth[name].shape:
                raise ModelError(
                    f"{path.name}: {name} is {list(answer[name].shape)}, PyTorch's {list(truth[name].shape)}"
                )
            if not np.isfinite(answer[name]).all():
                raise ModelError(f"{path.name}: {name} has values that are not finite")
            errors.append(error_of(answer[name], truth[name]).ravel())
        every = np.concatenate(errors)
        parities.append(Parity(name, float(every.max()), float(every.mean())))
    return parities


def missed(parities: Sequence[Parity], precision: str, bound: float) -> list[str]:
    """The outputs that are off by more than ``bound``."""
    return [p.output for p in parities if not (p.mean if precision == INT8 else p.largest) <= bound]


@torch.no_grad()
def reference(net: DepthAnything3Net, image: Tensor, wanted: Wanted) -> Outputs:
    """What the package's own functions make of an image (1, 3, H, W): the truth of a SingleView file."""
    height, width = image.shape[-2:]
    features, _ = net.backbone(image[:, None], cam_token=None, export_feat_layers=[])
    dense = net._process_depth_head(features, height, width)
    truth = {"depth": dense.depth[:, 0]}
    if net.cam_dec is not None:
        truth |= {"confidence": dense.depth_conf[:, 0], "rays": dense.ray[:, 0]}
        matrix = net._process_camera_estimation(features, height, width, dense).intrinsics[:, 0]
        truth["intrinsics"] = matrix - torch.tensor(HALF_PIXEL)
    else:
        truth["sky"] = dense.sky[:, 0]
    outputs = {name: value.numpy() for name, value in truth.items()}
    if wanted.descriptor:
        channels = net.backbone.pretrained.embed_dim
        tensor = features[-1][1].numpy()
        if wanted.descriptor != TOKEN:
            patches = features[1][0][:, 0, :, -channels:].numpy()
            tensor = patches.transpose(0, 2, 1).reshape(1, channels, height // PATCH, width // PATCH)
        outputs["descriptor"] = pool(tensor, wanted.descriptor)[None]
    return outputs


def nested_reference(relative: Outputs, metric: Outputs) -> Outputs:
    """The truth of a Nested file from both parts' truths, by design in plain numpy."""
    d, m = (part["depth"].astype(np.float64) for part in (relative, metric))
    ground = metric["sky"] < SKY_LIMIT
    median = np.median(relative["confidence"][ground]) if ground.any() else np.inf
    mask = ground & (relative["confidence"] >= median) & (d > 0) & (m > 0)
    factor = (d[mask] @ m[mask]) / max(d[mask] @ d[mask], 1e-12)
    return {**relative, "depth": (factor * d).astype(np.float32), "sky": metric["sky"]}


@torch.no_grad()
def several_views_reference(
    net: DepthAnything3Net, images: Tensor, extrinsics: Tensor, intrinsics: Tensor
) -> Outputs:
    """The same for N images with cameras: the package's forward pass itself, and its head's rays."""
    whole = net(images[None], extrinsics[None], intrinsics[None])
    height, width = images.shape[-2:]
    token = net.cam_enc(extrinsics[None], intrinsics[None], (height, width))
    features, _ = net.backbone(images[None], cam_token=token, export_feat_layers=[])
    rays = net._process_depth_head(features, height, width).ray
    return {
        "depth": whole.depth[0].numpy(),
        "confidence": whole.depth_conf[0].numpy(),
        "predicted_extrinsics": whole.extrinsics[0].numpy(),
        "predicted_intrinsics": (whole.intrinsics[0] - torch.tensor(HALF_PIXEL)).numpy(),
        "rays": rays[0].numpy(),
    }
