"""Measures a depth network on a recording with sensor depth: how wrong, by what factor, for how long.

    python tools/measure_depth.py FOLDER --model MODEL [--every N] [--light SHARE]

FOLDER is a TUM RGB-D (or BONN) or 7-Scenes folder. Printed are AbsRel and delta < 1.25 over pixels, the mean
ratio true / predicted (what the scale of a perfect run would settle at), its spread from frame to frame and
the autocorrelation of that spread, which says how many frames are worth one independent one. With --light the
images have a share of their light, and the noise that goes with it.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.bus.pack import as_sent, rgb
from prism_edge.cli.settings import whole_above_zero
from prism_edge.config import DepthConfig, SourceConfig
from prism_edge.depth import DepthNetwork, open_network
from prism_edge.depth.prediction import Prediction
from prism_edge.depth.providers import native_line
from prism_edge.depth.straight import as_shown
from prism_edge.errors import PrismError
from prism_edge.geometry.cameras import Camera
from prism_edge.sources.base import Image
from prism_edge.sources.open import open_source
from prism_edge.sources.sensor_depth import SensorDepth, image_to_depth
from tools.little_light import dimmed, share_of_light

F64 = NDArray[np.float64]

NEAREST, FARTHEST = 0.3, 10.0  # m, what depth cameras are good for
LEAST_PIXELS = 500
LAGS_S = (1 / 3, 1.0, 3.0)


@dataclass(frozen=True)
class FrameScore:
    """One frame: errors over its pixels, and the log of its median ratio true / predicted."""

    stamp_ns: int
    absrel: float
    within_125: float
    log_ratio: float
    inference_ms: float


def main(arguments: list[str] | None = None) -> int:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("folder", metavar="FOLDER", type=Path)
    parser.add_argument("--model", required=True, help="ONNX file, known name, or nested:RELATIVE,METRIC")
    parser.add_argument("--every", type=whole_above_zero, default=3, metavar="N", help="each N-th frame (3)")
    parser.add_argument("--light", type=share_of_light, default=1.0, metavar="SHARE", help="so much light")
    parser.add_argument("--threads", type=whole_above_zero, default=1, metavar="N", help="an inference (1)")
    args = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    try:
        network = open_network(args.model, DepthConfig(model=args.model, threads=args.threads))
        scores, unscored = measure(args.folder, network, args.every, args.light)
    except PrismError as error:
        print(f"measure_depth: error: {error}", file=sys.stderr)
        return error.exit_code
    if not scores:
        print(f"measure_depth: error: no frame has a score: {unscored[-1] if unscored else 'none was read'}",
              file=sys.stderr)
        return 1
    print(f"{network.name} on {args.folder.name}, provider {network.provider}")
    for line in summary(scores):
        print("  " + line)
    print(f"  frames without a score: {len(unscored)}" + (f" (the last: {unscored[-1]})" if unscored else ""))
    for name, count in network.counters.items():
        print(f"  {name}: {count}")
    return 0


def measure(
    folder: Path, network: DepthNetwork, every: int, light: float = 1.0
) -> tuple[list[FrameScore], list[str]]:
    """Scores of each ``every``-th frame, and why each of the others of those has none."""
    scores, unscored = [], []
    sensor = SensorDepth(folder)
    with open_source(SourceConfig(uri=str(folder))) as source:
        while (slot := source.peek()) is not None:
            if slot.index % every:
                source.skip()
                continue
            image, truth = source.read(), sensor.in_colour(slot.index, source.camera)
            score, why = None, "no picture, or no sensor depth"
            if isinstance(image, Image) and truth is not None:
                try:
                    pixels = dimmed(image.pixels, light, slot.index)
                    shown = as_shown(network, source.camera)
                    predicted = shown.infer(rgb(as_sent(pixels, source.camera)), source.camera)
                    score = score_frame(image.stamp_ns, predicted, truth, source.camera)
                    why = predicted.reason or "too few pixels have both depths"
                except Exception as error:  # native code raises anything; the other frames have their scores
                    why = f"an inference failed: {native_line(error)}"
            if score is None:
                unscored.append(why)
            else:
                scores.append(score)
    return scores, unscored


def score_frame(
    stamp_ns: int, predicted: Prediction, truth: NDArray[np.float32], camera: Camera
) -> FrameScore | None:
    """Compares at the network's pixels; None where too few have both depths."""
    a, b, c, d = predicted.image_to_depth
    rows, columns = np.mgrid[0 : predicted.depth.shape[0], 0 : predicted.depth.shape[1]]
    x, y = (columns - b) / a, (rows - d) / c
    a, b, c, d = image_to_depth(truth, camera)
    x, y = a * x + b, c * y + d
    # Nearest: blending across an edge, or with the 0 of an invalid pixel, gives a depth that nothing has.
    seen = cv2.remap(
        truth, x.astype(np.float32), y.astype(np.float32), cv2.INTER_NEAREST, None, cv2.BORDER_CONSTANT, 0
    )
    both = (seen > NEAREST) & (seen < FARTHEST) & (predicted.depth > 0)
    if not predicted.valid or both.sum() < min(LEAST_PIXELS, predicted.depth.size // 4):
        return None
    ratio = seen[both].astype(np.float64) / predicted.depth[both]
    return FrameScore(
        stamp_ns,
        absrel=float(np.mean(np.abs(1.0 / ratio - 1.0))),
        within_125=float(np.mean(np.maximum(ratio, 1.0 / ratio) < 1.25)),
        log_ratio=float(np.log(np.median(ratio))),
        inference_ms=predicted.inference_ms,
    )


def mean_ratio(scores: list[FrameScore]) -> float:
    """True over predicted, geometric mean of the frames: what a perfect run's scale would settle at."""
    return float(np.exp(np.mean([score.log_ratio for score in scores])))


def summary(scores: list[FrameScore]) -> list[str]:
    """The figures in words."""
    logs = np.array([score.log_ratio for score in scores])
    stamps = np.array([score.stamp_ns for score in scores], dtype=np.float64) / 1e9
    lines = [
        f"frames: {len(scores)} over {stamps[-1] - stamps[0]:.1f} s",
        f"AbsRel: {np.mean([score.absrel for score in scores]):.3f}",
        f"delta < 1.25: {np.mean([score.within_125 for score in scores]):.3f}",
        f"mean ratio true / predicted: {mean_ratio(scores):.3f}",
        f"spread of the frames' log ratio: {logs.std():.3f}",
        f"inference: median {np.median([score.inference_ms for score in scores]):.1f} ms",
    ]
    for lag in LAGS_S:
        value = autocorrelation(stamps, logs, lag)
        lines.append(f"autocorrelation at {lag:.2f} s: " + ("-" if np.isnan(value) else f"{value:.2f}"))
    return lines


def autocorrelation(stamps: F64, values: F64, lag_s: float) -> float:
    """Correlation of values (n,) with those ``lag_s`` later; nan where there are too few pairs."""
    order = np.searchsorted(stamps, stamps + lag_s - 1e-6)
    first = np.flatnonzero(order < len(stamps))
    second = order[first]
    near = np.abs(stamps[second] - stamps[first] - lag_s) < 0.25 * lag_s
    if near.sum() < 10 or np.std(values) == 0:
        return float("nan")
    centred = values - values.mean()
    return float(np.mean(centred[first[near]] * centred[second[near]]) / np.var(values))


if __name__ == "__main__":
    sys.exit(main())
