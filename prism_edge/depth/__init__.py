"""Depth networks: their contract, the session that runs one, the pairing of two."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from prism_edge.config import DepthConfig
from prism_edge.depth.folders import folders
from prism_edge.depth.pairing import PairedNetwork
from prism_edge.depth.prediction import Prediction
from prism_edge.depth.pulled import find_pulled, pulled_files
from prism_edge.depth.registry import File, entries, find
from prism_edge.depth.session import OnnxNetwork
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import Camera
from prism_edge.named_path import hindrance, named_path

NESTED = "nested:"


class DepthNetwork(Protocol):
    """Anything that gives metric depth for an image."""

    name: str
    identity: str  # whose answers can be compared with whose (depth/fingerprint.py)
    bias_sigma: float  # log-scale error that never averages out
    dsug: tuple[float, float]  # the uncertainty gate's tau and T fitted for it; (nan, nan): not fitted
    provider: str  # execution provider it really runs on
    counters: dict[str, int]  # events worth showing on `health`

    def infer(self, rgb: NDArray[np.uint8], camera: Camera) -> Prediction:
        """Metric depth of an image (height, width, 3) uint8 RGB that ``camera`` took."""
        ...


def open_network(spec: str, config: DepthConfig) -> DepthNetwork:
    """The network that ``spec`` names, warmed up: a file, a registered name, or nested:RELATIVE,METRIC.

    Raises ModelError, in one line, where it can't be found or run, or has no metres.
    """
    parts = networks_of(spec)
    if len(parts) == 2:
        return PairedNetwork(open_onnx(parts[0], config), open_onnx(parts[1], config))
    network = open_onnx(spec, config)
    if not network.card.has_metres:
        raise ModelError(
            f"{network.name} predicts {network.card.depth_kind.replace('_', ' ')} depth, which has no "
            f"metres; pair it with a metric network: --model nested:{spec},METRIC (such as fastdepth_nyu)"
        )
    return network


def networks_of(spec: str) -> list[str]:
    """The files or names that ``spec`` is made of: one, or the two of nested:. Raises ModelError."""
    if not spec.startswith(NESTED):
        return [spec]
    parts = [part.strip() for part in spec.removeprefix(NESTED).split(",")]
    if len(parts) != 2 or not all(parts):
        raise ModelError(f"model {spec!r}: nested takes two networks, nested:RELATIVE,METRIC")
    return parts


def open_onnx(spec: str, config: DepthConfig) -> OnnxNetwork:
    """One network of any kind by file or registered name, warmed up. Raises ModelError."""
    path = locate(spec)
    return OnnxNetwork(path, config, pinned_for(spec, path))


def pinned_for(spec: str, path: Path) -> tuple[File, ...]:
    """What the files must be of a network that was located by ``spec``; empty: anything.

    Files found through a name, or that were pulled, must be those files; any other may be any.
    """
    return pulled_files(path) if path == named_path(spec) else pinned_files(spec)


def pinned_files(name: str) -> tuple[File, ...]:
    """The files of the network of that name, registered or pulled, with their digests; none where unknown."""
    entry, pulled = find(name), find_pulled(name)
    if entry and entry.card:
        return entry.files
    return pulled.files if pulled and pulled.runnable else ()


def locate(spec: str) -> Path:
    """The file of a path or registered name. Raises ModelError where there is none."""
    if not spec:
        raise ModelError("model '': the name is empty")
    path = named_path(spec)
    if os.path.isfile(path):  # pathlib's raises where a folder is closed to us
        return path
    entry = find(spec)
    if entry is None:
        pulled = find_pulled(spec)
        if pulled and pulled.runnable:
            return pulled.path
        if os.path.isdir(path):
            raise ModelError(f"model {spec!r} is a folder; an ONNX file is needed")
        if path.suffix == ".onnx" or len(path.parts) > 1:
            hindered = hindrance(path)
            what = f"can't be read ({hindered})" if hindered else "there is no such file"
            raise ModelError(f"model {spec!r}: {what}")
        known = ", ".join(item.name for item in entries() if item.card)
        raise ModelError(f"model {spec!r} is neither a file nor a registered name ({known})")
    if entry.card is None:
        raise ModelError(f"model {spec}: a checkpoint to be exported to ONNX first; then give that file")
    found = entry.located()
    if found is None:
        places = ", ".join(str(folder) for folder in folders())
        how = f"`prism-edge models pull {spec}` gets it" if entry.can_be_pulled else "put it there"
        raise ModelError(
            f"model {spec}: its file {entry.file} is in none of {places}; {how} or give its path "
            "(docs/MODELS.md)"
        )
    return found
