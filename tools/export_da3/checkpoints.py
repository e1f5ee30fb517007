"""A checkpoint's network with its weights."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from depth_anything_3.cfg import create_object, load_config
from depth_anything_3.model.da3 import DepthAnything3Net
from depth_anything_3.registry import MODEL_REGISTRY
from depth_anything_3.utils.model_loading import convert_general_state_dict

from prism_edge.errors import ModelError, first_line
from tools.export_da3.variants import NESTED, VARIANTS, Variant, parts_of, weights_file

# Metres = output * f / 300, f in pixels of the network's input (the package's apply_metric_scaling).
METRIC_FOCAL_LENGTH = 300.0


@dataclass(frozen=True)
class Checkpoint:
    """A network with its weights. ``revision`` says which: a digest's beginning, or random-SEED."""

    variant: Variant
    net: DepthAnything3Net
    revision: str


def load(path: Path, name: str) -> list[Checkpoint]:
    """The checkpoint in a folder or file (.safetensors, .pth); a nested one holds two, relative and metric.

    Raises ModelError where there is none or its weights are not those of ``name``.
    """
    file = weights_file(path)
    weights = _read(file)
    with file.open("rb") as content:
        revision = "sha256:" + hashlib.file_digest(content, "sha256").hexdigest()[:12]
    prefixes = ("model.da3.", "model.da3_metric.") if name == NESTED else ("model.",)
    return [
        Checkpoint(VARIANTS[part], _filled(part, weights, prefix, file), revision)
        for part, prefix in zip(parts_of(name), prefixes, strict=True)
    ]


def random(name: str, seed: int) -> list[Checkpoint]:
    """The architecture of ``name`` with seeded random weights, for tests: its depths mean nothing."""
    checkpoints = []
    for part in parts_of(name):
        torch.manual_seed(seed)
        net = build(part)
        with torch.no_grad():
            for key, value in net.named_parameters():
                if key.endswith(("pos_embed", "cls_token")):  # zeros when new: would hide a wrong resizing
                    value.normal_(0.0, 0.5)
                elif key.endswith("fc_fov.0.bias"):
                    value.fill_(1.0)  # radians; a field of view of 0 has no focal length
                elif key.endswith("output_conv2.2.weight"):
                    value.mul_(5.0)  # depths that differ by more than a few percent
                elif key.endswith("sky_output_conv2.2.bias"):
                    value.fill_(0.3)  # at the limit: some pixels are sky, some are not
        checkpoints.append(Checkpoint(VARIANTS[part], net, f"random-{seed}"))
    return checkpoints


def build(name: str) -> DepthAnything3Net:
    """The package's network ``name`` as it is when new, without the Gaussian head."""
    config = load_config(MODEL_REGISTRY[name])
    for part in ("gs_head", "gs_adapter"):
        config.pop(part, None)
    return create_object(config).eval().requires_grad_(False)


def _read(file: Path) -> dict[str, torch.Tensor]:
    try:
        if file.suffix == ".safetensors":
            from safetensors.torch import load_file

            weights: Any = load_file(str(file))
        else:
            weights = torch.load(str(file), map_location="cpu", weights_only=True)  # runs no pickled code
            weights = weights.get("state_dict", weights.get("model", weights))
    except Exception as error:  # safetensors', torch's and zipfile's, without a common root
        why = first_line(error, 100)
        if "GLOBAL" in str(error):  # torch's word for code, in lines with escapes for a terminal
            why = "it holds pickled code, which is not run: save the network's state_dict()"
        raise ModelError(f"{file}: can't be read as weights ({why})") from None
    if not isinstance(weights, dict) or not all(isinstance(item, torch.Tensor) for item in weights.values()):
        raise ModelError(f"{file}: holds no table of tensors")
    return weights


def _filled(name: str, weights: dict[str, torch.Tensor], prefix: str, file: Path) -> DepthAnything3Net:
    """The network ``name`` with those of the weights that begin with ``prefix`` (or with nothing)."""
    net = build(name)
    own = net.state_dict(keep_vars=True)
    candidates = [
        {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)},
        weights,
        # Training checkpoints use other names for the same parts.
        {k.removeprefix("model."): v for k, v in convert_general_state_dict(dict(weights)).items()},
        {
            k.removeprefix("model."): v
            for k, v in convert_general_state_dict({f"module.{k}": v for k, v in weights.items()}).items()
        },
    ]
    table = max(candidates, key=lambda table: len(own.keys() & table.keys()))
    # Layers that share their weights may be saved under one of their names.
    given = {own[key].data_ptr() for key in own.keys() & table.keys()}
    missing = [key for key, value in own.items() if value.data_ptr() not in given]
    if missing:
        raise ModelError(f"{file}: is not {name}: {len(missing)} weights are missing, such as {missing[0]}")
    for key in own.keys() & table.keys():
        if own[key].shape != table[key].shape:
            raise ModelError(
                f"{file}: is not {name}: {key} is {list(table[key].shape)}, not {list(own[key].shape)}"
            )
    net.load_state_dict({key: table[key].float() for key in own.keys() & table.keys()}, strict=False)
    return net
