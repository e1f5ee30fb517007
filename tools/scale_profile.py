#!/usr/bin/env python3
"""How a depth network's scale errs on an RGB-D recording, and what the scale filter makes of it.

For every k-th frame: features as the tracker finds them, network depth over sensor depth at each, and the
least-squares log ratio of the frame. Printed are its mean, spread and autocorrelation, then the filter run
on these as if the map were perfect, from many starting points: its error against the sigma that it claims.

    python tools/scale_profile.py SEQUENCE --model fastdepth_nyu --every 3
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:  # run from a checkout
    sys.path.insert(0, str(ROOT))

from prism_edge.bus.pack import as_sent, grey, rgb  # noqa: E402
from prism_edge.cli.settings import whole_above_zero  # noqa: E402
from prism_edge.config import Config, DepthConfig, ScaleConfig, SourceConfig  # noqa: E402
from prism_edge.depth import open_network  # noqa: E402
from prism_edge.depth.straight import as_shown  # noqa: E402
from prism_edge.errors import PrismError, SourceError  # noqa: E402
from prism_edge.messages import F32  # noqa: E402
from prism_edge.scale.filter import ScaleFilter  # noqa: E402
from prism_edge.scale.least_squares import Observation, weighted_least_squares  # noqa: E402
from prism_edge.scale.samples import depth_at, sample  # noqa: E402
from prism_edge.sources.base import Image, Source  # noqa: E402
from prism_edge.sources.open import open_source  # noqa: E402
from prism_edge.sources.sensor_depth import SensorDepth, image_to_depth  # noqa: E402
from prism_edge.tracking.features import OrbExtractor  # noqa: E402
from tools.measure_depth import autocorrelation  # noqa: E402

Array = NDArray[np.float64]
LAGS_S = (1 / 3, 1.0, 2.0, 3.0)
AFTER_S = (1.0, 2.0, 5.0, 10.0, 20.0)
SPAN_S = 3.0  # between the starting points of the filter


@dataclass(frozen=True)
class Series:
    """One observation of log(network / sensor) a frame: times (n,) s, and what least squares made of it."""

    times_s: Array
    observations: list[Observation]
    whole_image: Array  # (n,) median log ratio over all pixels, for comparison

    @property
    def values(self) -> Array:
        return np.array([o.log_scale for o in self.observations])


def profile(folder: Path, model: str, camera_file: str, every: int, config: ScaleConfig) -> Series:
    """Runs the network over every k-th frame of a recording."""
    sensor = SensorDepth(folder)
    network = open_network(model, DepthConfig())
    extractor = OrbExtractor(Config().tracking)
    times, observations, whole = [], [], []
    with open_source(SourceConfig(uri=str(folder), camera=camera_file)) as source:
        for image in _frames(source, every):
            camera = source.camera
            truth = sensor.in_colour(image.index, camera)
            if truth is None:
                continue
            sent = as_sent(image.pixels, camera)
            prediction = as_shown(network, camera).infer(rgb(sent), camera)
            pixels = extractor.extract(grey(sent), camera).pixels
            to_sensor = image_to_depth(truth, camera)
            raw = camera.distort_pixels(pixels)
            depths, ok = depth_at(truth, raw * to_sensor[[0, 2]] + to_sensor[[1, 3]])
            samples = sample(
                camera,
                pixels,
                np.where(ok, depths, 0.0),
                np.full(len(pixels), 90.0),
                prediction.depth,
                prediction.image_to_depth,
                config.min_parallax_deg,
            )
            observation = weighted_least_squares(
                samples.log_ratios,
                samples.patches,
                np.ones(len(samples)),
                config.point_sigma,
                config.frame_sigma,
                config.min_points,
            )
            if observation is None:
                continue
            times.append(image.stamp_ns * 1e-9)
            observations.append(observation)
            whole.append(_whole_image(truth, to_sensor, prediction.depth, prediction.image_to_depth))
    return Series(np.array(times), observations, np.array(whole))


def _frames(source: Source, every: int) -> Iterator[Image]:
    while (slot := source.peek()) is not None:
        if slot.index % every:
            source.skip()
        elif isinstance(image := source.read(), Image):
            yield image


def _whole_image(truth: F32, to_sensor: Array, depth: F32, to_depth: Array) -> float:
    y, x = np.mgrid[0 : truth.shape[0] : 4, 0 : truth.shape[1] : 4]
    values = truth[y, x].ravel()
    pixels = (np.column_stack([x.ravel(), y.ravel()]) - to_sensor[[1, 3]]) / to_sensor[[0, 2]]
    predicted, _ = depth_at(depth, pixels * to_depth[[0, 2]] + to_depth[[1, 3]], np.inf)
    both = (values > 0.0) & (predicted > 0.0)
    return float(np.median(np.log(predicted[both] / values[both]))) if both.any() else float("nan")


def filtered(series: Series, first: int, config: ScaleConfig) -> tuple[Array, Array, Array]:
    """Times since the start (s), error and sigma of a filter on a perfect map that begins at frame ``first``.

    The map's unit is that frame's network depth; the truth is the mean ratio that the network has on this
    recording, which is all that a filter can find (the rest is bias_sigma's).
    """
    unit, truth = float(series.values[first]), float(series.values.mean() - series.values[first])
    scale = ScaleFilter(config)
    rows: list[tuple[float, float, float]] = []
    for time, observation in zip(series.times_s[first:], series.observations[first:], strict=True):
        scale.predict(float(time), 0.0)
        if rows:
            scale.update(replace(observation, log_scale=observation.log_scale - unit))
        else:
            scale.fix_unit()
        rows.append((float(time - series.times_s[first]), scale.log_scale - truth, scale.sigma))
    since, error, sigma = np.array(rows).T
    return since, error, sigma


def report(series: Series, config: ScaleConfig) -> str:
    """The figures in words."""
    values, half = series.values, len(series.values) // 2
    lines = [
        f"frames {len(values)} over {np.ptp(series.times_s):.1f} s, "
        f"{np.mean([o.points for o in series.observations]):.0f} points each",
        f"log(network / sensor) at features: mean {values.mean():+.3f}, sigma {values.std():.3f}, "
        f"halves {values[:half].mean():+.3f} {values[half:].mean():+.3f}",
        f"                   whole image:    mean {np.nanmean(series.whole_image):+.3f}, "
        f"sigma {np.nanstd(series.whole_image):.3f}",
        "autocorrelation: "
        + ", ".join(f"{autocorrelation(series.times_s, values, s):.2f} at {s:.2g} s" for s in LAGS_S),
    ]
    step = max(1, round(SPAN_S / float(np.median(np.diff(series.times_s)))))
    runs = [filtered(series, first, config) for first in range(0, len(values) - 1, step)]
    lines.append(f"filter on a perfect map, {len(runs)} starts {SPAN_S:g} s apart:")
    for after in (0.0, *AFTER_S):
        at = [(e[i], s[i]) for t, e, s in runs for i in [int(np.searchsorted(t, after))] if i < len(t)]
        if at:
            error, sigma = np.array(at).T
            lines.append(
                f"  after {after:4.0f} s: error {np.sqrt(np.mean(error**2)):.3f} rms, "
                f"sigma {sigma.mean():.3f}, (error/sigma)^2 {np.mean((error / sigma) ** 2):.2f} "
                f"({len(at)} runs)"
            )
    since, error, sigma = runs[0]
    settled = since[np.flatnonzero(np.abs(error) > 0.05)[-1]] if (np.abs(error) > 0.05).any() else 0.0
    lines.append(
        f"  from the first frame: final error {error[-1]:+.3f}, sigma {sigma[-1]:.3f}; "
        f"beyond 5 % for the last time after {settled:.1f} s; "
        f"wanders {np.std(error[len(error) // 2 :]):.3f} in the second half"
    )
    return "\n".join(lines)


def main() -> int:
    """Command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("sequence", type=Path, help="7-Scenes or TUM RGB-D folder with sensor depth")
    parser.add_argument("--model", required=True, help="network: file or registered name")
    parser.add_argument("--camera", default="", help="camera file, where the folder isn't known")
    parser.add_argument("--every", type=whole_above_zero, default=3, help="use every k-th frame (default 3)")
    parser.add_argument("--frame-sigma", type=float, default=ScaleConfig().frame_sigma)
    parser.add_argument("--correlation-s", type=float, default=ScaleConfig().correlation_s)
    arguments = parser.parse_args()
    config = ScaleConfig(frame_sigma=arguments.frame_sigma, correlation_s=arguments.correlation_s)
    try:
        series = profile(arguments.sequence, arguments.model, arguments.camera, arguments.every, config)
        if len(series.times_s) < 2:
            raise SourceError(f"{arguments.sequence}: fewer than two frames have sensor depth")
    except PrismError as error:
        print(f"scale_profile: error: {error}", file=sys.stderr)
        return error.exit_code
    print(report(series, config))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
