"""Measures how long a rolling shutter takes to read an image, on a recording whose camera turned about.

    python tools/measure_readout.py SOURCE [--camera FILE] [--model MODEL] [--frames N]

The recording is tracked over and over, each time with another `tracking.readout_ms`: where nothing of a
readout is left in the residuals, that is it. (The map takes a part of it in, so one time is not enough: who
says nothing of 26 ms finds 5.) MODEL is as for `prism-edge run`; a simulated SOURCE has the bundled network.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.bus.pack import as_sent, grey, rgb
from prism_edge.calibration.readout import ReadoutFit
from prism_edge.cli.settings import BUNDLED
from prism_edge.config import DepthConfig, SourceConfig, TrackingConfig
from prism_edge.depth import DepthNetwork, open_network
from prism_edge.depth.prediction import checked
from prism_edge.errors import ConfigError, PrismError
from prism_edge.geometry.cameras import LONGEST_READOUT_MS
from prism_edge.geometry.poses import Array, inverse, transform
from prism_edge.sources.base import Image
from prism_edge.sources.open import open_source
from prism_edge.sources.sim import is_simulated
from prism_edge.tracking.tracker import Tracker
from prism_edge.workers.tracker import SEED_DEPTH_SIGMA

STEP_MS, LEAST_RUNS = 10.0, 5
CLEAR = 3.0  # sigmas of the line's slope that a recording tells with
BENT_MS = 5.0  # what a map that bends, alike each time, makes of it: by simulated rooms (docs/CAMERAS.md)


def main(arguments: list[str] | None = None) -> int:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("source", metavar="SOURCE", help="folder, video or sim: address")
    parser.add_argument("--camera", default="", metavar="FILE", help="intrinsics, as for `prism-edge run`")
    parser.add_argument("--model", metavar="MODEL", help="ONNX file, known name, or nested:RELATIVE,METRIC")
    parser.add_argument("--frames", type=int, default=0, metavar="N", help="of the recording; 0: all")
    args = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    try:
        model = args.model or (BUNDLED if is_simulated(args.source) else "")
        if not model:
            raise ConfigError("a recording needs a depth network: --model")
        source = SourceConfig(uri=args.source, camera=args.camera, frames=args.frames)
        network = open_network(model, DepthConfig(model=model))
        found = search(lambda said: left_over(source, network, said))
    except PrismError as error:
        print(f"measure_readout: error: {error}", file=sys.stderr)
        return error.exit_code
    if found is None:
        print("measure_readout: error: the recording does not tell: its camera must turn", file=sys.stderr)
        return 1
    said, sigma = found[0], math.hypot(found[1], BENT_MS)
    print(f"rows are read over {said:.0f} ms (sigma {sigma:.0f}): readout_ms: {said:.0f} in the camera file")
    return 0


def search(left_over: Callable[[float], tuple[float, float]]) -> tuple[float, float] | None:
    """The readout (ms) of which nothing is left, and its sigma; None where the recording does not tell.

    ``left_over`` gives what is missing of a readout that is said, and the sigma of that. Each time the
    tracker goes another way by chance, so a straight line is drawn through all.
    """
    tried: list[tuple[float, float, float]] = []  # readout said, what was left, its sigma
    said, step = 0.0, STEP_MS
    while abs(said) <= LONGEST_READOUT_MS:
        left, sigma = left_over(said)
        if not math.isfinite(left):
            return None
        tried.append((said, left, sigma))
        print(f"{said:.0f} ms said: {left:+.1f} left (sigma {sigma:.1f})", flush=True)
        step = math.copysign(STEP_MS, tried[0][1])
        if len(tried) >= LEAST_RUNS and left * step <= 0.0:
            break
        said += step
    return where_nothing_is_left(np.array(tried))


def where_nothing_is_left(tried: Array) -> tuple[float, float] | None:
    """Where a line through rows (readout said, what was left, its sigma) is at 0, and its sigma."""
    said, left, sigma = tried.T
    line, covariance = np.polyfit(said, left, 1, w=1.0 / sigma, cov="unscaled")
    spread = np.sum(((left - np.polyval(line, said)) / sigma) ** 2) / (len(tried) - 2)
    covariance *= max(1.0, spread)
    slope, offset = line
    if slope > -CLEAR * math.sqrt(covariance[0, 0]):
        return None
    by_line = np.array([offset / slope**2, -1.0 / slope])
    return float(-offset / slope), float(np.sqrt(by_line @ covariance @ by_line))


def left_over(source_config: SourceConfig, network: DepthNetwork, said_ms: float) -> tuple[float, float]:
    """What is missing of the readout that is said once a recording is tracked by it, and its sigma (ms)."""
    tracker, fit = Tracker(TrackingConfig(readout_ms=said_ms)), ReadoutFit()
    sigma = float(np.hypot(SEED_DEPTH_SIGMA, network.bias_sigma))
    with open_source(source_config) as source:
        camera = replace(source.camera, readout_ms=0.0)  # what its file says already is what is asked
        while source.peek() is not None:
            image = source.read()
            if not isinstance(image, Image):
                continue
            frame = as_sent(image.pixels, source.camera)
            tracker.process(image.index, image.stamp_ns, grey(frame), camera)
            _hear(tracker, fit)
            keyframe = tracker.maybe_keyframe()
            tracker.map_keyframe()
            if keyframe is not None:
                seen = checked(network.infer(rgb(frame), source.camera))
                if seen.valid:
                    tracker.add_depth(keyframe.id, seen.depth, seen.image_to_depth, sigma)
                else:
                    tracker.add_no_depth(keyframe.id)
    return fit.left_ms


def _hear(tracker: Tracker, fit: ReadoutFit) -> None:
    """Add what was just tracked, as the map has it."""
    result, frame, twist = tracker.last_result, tracker.last, tracker.motion.twist
    if result is None or result.world_from_camera is None or frame is None or not twist.any():
        return
    keypoints = np.flatnonzero(frame.points >= 0)
    table = tracker.world.points
    points = table.position[table.rows(frame.points[keypoints])]
    pixels = frame.features.pixels[keypoints]
    fit.add(
        frame.camera,
        transform(inverse(frame.world_from_camera), points),
        pixels,
        frame.camera.distort_pixels(pixels)[:, 1],
        tracker.scale_factor ** frame.features.octaves[keypoints],
        twist,
    )


if __name__ == "__main__":
    sys.exit(main())
