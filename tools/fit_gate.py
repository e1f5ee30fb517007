#!/usr/bin/env python3
"""Fits the uncertainty gate's tau and T to a depth network, on recordings in which nothing moves.

    python tools/fit_gate.py SEQUENCE... --model fastdepth_nyu [--every 12] [--poses FILE.tum]

Every k-th frame of each SEQUENCE (with true poses, or --poses for a single one) is taken for a keyframe. Its
features, as the tracker finds them, get the uncertainty u that the daemon would give them. All of them stand
still, so what u has is the network's noise: tau is the level that a tenth of them exceeds, and T is such that
a feature of median u weighs 0.9. Printed are those, u's quantiles for each recording, and the two lines that
go into the network's card.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:  # run from a checkout
    sys.path.insert(0, str(ROOT))

from prism_edge.bus.pack import as_sent, grey, rgb  # noqa: E402
from prism_edge.config import Config, DepthConfig, GateConfig, SourceConfig  # noqa: E402
from prism_edge.depth import DepthNetwork, open_network  # noqa: E402
from prism_edge.depth.straight import as_shown  # noqa: E402
from prism_edge.errors import ModelError, PrismError, SourceError  # noqa: E402
from prism_edge.evaluation.trajectory import read_tum  # noqa: E402
from prism_edge.scale.gate import DepthGate, DepthView, GateParameters  # noqa: E402
from prism_edge.sources.base import Image  # noqa: E402
from prism_edge.sources.open import open_source  # noqa: E402
from prism_edge.tracking.features import OrbExtractor  # noqa: E402
from tools.true_poses import own_truth, pose_of_image  # noqa: E402

Array = NDArray[np.float64]

EXCEEDED_BY = 0.1  # of static features: tau
WEIGHT_OF_MEDIAN = 0.9
ROUNDS = 4  # what counts as hidden goes by tau, which is what is being fitted
FIRST_GUESS = GateParameters(GateConfig().alpha, 0.2, 0.05)
Keyframes = list[tuple[DepthView, Array]]


def keyframes(folder: Path, network: DepthNetwork, every: int, poses: Path | None) -> Keyframes:
    """Depth views and their features' raw pixels, in metres of the given poses. Raises SourceError."""
    extractor = OrbExtractor(Config().tracking)
    made: Keyframes = []
    before = network.counters.get("unpaired", 0)
    with open_source(SourceConfig(uri=str(folder))) as source:
        truth = read_tum(poses) if poses else own_truth(str(folder))
        if not len(truth):
            raise SourceError(f"{folder} holds no true poses; give them with --poses FILE.tum")
        while (slot := source.peek()) is not None:
            if slot.index % every:
                source.skip()
                continue
            image = source.read()
            pose = pose_of_image(truth, slot.stamp_ns)
            if not isinstance(image, Image) or pose is None:
                continue
            sent = as_sent(image.pixels, source.camera)
            answer = as_shown(network, source.camera).infer(rgb(sent), source.camera)
            if not answer.valid:
                continue
            features = extractor.extract(grey(sent), source.camera)
            view = DepthView(
                slot.index,
                pose,
                source.camera,
                answer.depth,
                answer.image_to_depth,
                answer.confidence,
                1.0,
            )
            made.append((view, source.camera.distort_pixels(features.pixels)))
    alone = network.counters.get("unpaired", 0) - before  # images without the confidence that is fitted to
    if 2 * alone > len(made):
        why = getattr(network, "doubt", "") or "the two don't fit"
        raise ModelError(f"{folder}: {alone} of {len(made)} images were not paired: {why}")
    return made


def uncertainties(frames: Keyframes, parameters: GateParameters, memory: int) -> Array:
    """u of every feature that anything is known of."""
    gate, found = DepthGate(memory), []
    for view, pixels in frames:
        found.append(gate.assess(view, pixels, parameters).uncertainty)
        gate.remember(view)
    together = np.concatenate([*found, np.zeros(0)])
    return np.asarray(together[np.isfinite(together)])


def fit(recordings: list[Keyframes], memory: int) -> tuple[GateParameters, list[Array]]:
    """tau and T on all recordings, each counting alike, and their u. Raises SourceError without any u."""
    parameters = FIRST_GUESS
    each: list[Array] = []
    for _ in range(ROUNDS):
        each = [uncertainties(frames, parameters, memory) for frames in recordings]
        if any(len(u) == 0 for u in each):
            raise SourceError("a recording holds no two views of one place: nothing to fit to")
        tau = float(np.mean([np.quantile(u, 1.0 - EXCEEDED_BY) for u in each]))
        middle = float(np.mean([np.median(u) for u in each]))
        temperature = (tau - middle) / math.log(WEIGHT_OF_MEDIAN / (1.0 - WEIGHT_OF_MEDIAN))
        parameters = GateParameters(parameters.alpha, tau, max(temperature, 1e-4))
    return parameters, each


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequences", metavar="SEQUENCE", type=Path, nargs="+")
    parser.add_argument("--model", metavar="MODEL", required=True)
    parser.add_argument("--every", metavar="N", type=int, default=12, help="frames between keyframes")
    parser.add_argument("--poses", metavar="FILE.tum", type=Path)
    args = parser.parse_args(arguments)
    try:
        if args.every < 1 or (args.poses and len(args.sequences) > 1):
            raise SourceError("--every is at least 1, and --poses go with one SEQUENCE")
        network = open_network(args.model, DepthConfig())
        recordings = [keyframes(folder, network, args.every, args.poses) for folder in args.sequences]
        parameters, each = fit(recordings, GateConfig().memory)
    except PrismError as error:
        print(f"fit_gate: error: {error}", file=sys.stderr)
        return error.exit_code
    for folder, u in zip(args.sequences, each, strict=True):
        quantiles = " ".join(f"{value:.3f}" for value in np.quantile(u, (0.25, 0.5, 0.75, 0.9, 0.95)))
        share = float(np.mean(u > parameters.tau))
        print(f"{folder.name}: {len(u)} features, u at 25 50 75 90 95 %: {quantiles}; {share:.0%} above tau")
    print(f"dsug_tau: {parameters.tau:.3f}\ndsug_temperature: {parameters.temperature:.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
