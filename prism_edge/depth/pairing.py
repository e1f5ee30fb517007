"""A relative network's detail in a metric network's metres.

A relative network knows inverse depth, or depth, up to an unknown scale and shift for each image. Both are
fitted to the metric network's answer for the same image: 1 / z = slope * d + shift, or z itself.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.depth.contract import INVERSE_RELATIVE, RELATIVE
from prism_edge.depth.prediction import Prediction, checked, no_confidence, no_descriptor, normalised
from prism_edge.depth.providers import CPU, native_line
from prism_edge.depth.session import OnnxNetwork
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import F32

F64 = NDArray[np.float64]

log = logging.getLogger("prism_edge.depth")

GRID = (64, 48)  # columns and rows of samples: enough for two unknowns
LEAST_SAMPLES = 100
WORST_SPREAD = 0.4  # median relative residual beyond which the networks contradict each other
_LEAST = float(np.finfo(np.float32).tiny)  # of a relative depth: its inverse is a number, too
_NEARLY_ALL = 0.98  # share of positive relative depths from which their inverse is tried
_ITERATIONS = 10
_RECENT, _TELLING = 20, 5  # images that tell whether two networks are a pair; so many of them at least
_HUBER = 1.345  # sigmas; 95 % efficient on Gaussian noise


@dataclass(frozen=True)
class Fit:
    """1 / z = slope * d + shift, or z where ``of_depth``; ``spread`` is the median relative residual."""

    slope: float
    shift: float
    spread: float
    of_depth: bool = False


def fit_inverse_depth(relative: F64, metric: F64) -> Fit | None:
    """Robust fit of metres (n,) by relative inverse depths (n,); None where there is no sensible one.

    Iteratively reweighted least squares with Huber weights on the residual slope d + shift - 1 / z: in
    inverse depth the near, which metric networks know best, weighs most (on real video it beats the
    relative residual, AbsRel 0.175 against 0.195: docs/MODELS.md). The first weights come from a line
    through the medians of the nearest and the farthest third, so that outliers do not choose the basin.
    """
    return _fit(relative, metric, of_depth=False)


def fit_depth(relative: F64, metric: F64) -> Fit | None:
    """As :func:`fit_inverse_depth` of relative depths (n,): the better fit of 1 / z by 1 / d and of z by d.

    The latter, which alone knows a shift of depth, is of relative residuals, else the far would outweigh all.
    Exactly 0 is no depth, and infinity, of the sky, is none either. Below 0 lies a depth whose shift is
    unknown: 1 / d of it has no sense, and is tried only where nearly all values are above.
    """
    said = np.isfinite(relative) & (relative != 0)
    positive = said & (relative > 0)
    nearly_all = np.sum(positive) >= _NEARLY_ALL * np.sum(said)
    fits = (
        _fit(1.0 / relative[positive], metric[positive], of_depth=False) if nearly_all else None,
        _fit(relative[said], metric[said], of_depth=True),
    )
    return min((fit for fit in fits if fit), key=lambda fit: fit.spread, default=None)


def _fit(relative: F64, metric: F64, of_depth: bool) -> Fit | None:
    usable = np.isfinite(relative) & np.isfinite(metric) & (metric > 0)
    d, z = relative[usable], metric[usable]
    if d.size < LEAST_SAMPLES:
        return None
    low, middle, high = (float(value) for value in np.percentile(d, (5, 50, 95)))
    extent = high - low
    if not extent > 1e-6 * max(abs(low), abs(high)):
        return None
    d = (d - middle) / extent  # well conditioned whatever the network's unit
    design, target = np.stack([d, np.ones_like(d)], axis=1), z if of_depth else 1.0 / z
    solution: F64 = _line_through_thirds(d, target)
    if of_depth:
        design, target = design / z[:, None], np.ones_like(z)
    for _ in range(_ITERATIONS):
        residual = np.abs(design @ solution - target)
        sigma = max(1.4826 * float(np.median(residual)), 1e-9)
        weight = np.minimum(1.0, _HUBER * sigma / np.maximum(residual, 1e-12))
        normal = design.T @ (design * weight[:, None])
        if np.linalg.cond(normal) > 1e12:
            return None
        solution = np.asarray(np.linalg.solve(normal, design.T @ (weight * target)), dtype=np.float64)
    spread = float(np.median(np.abs(design @ solution - target) / target))
    slope, shift = float(solution[0] / extent), float(solution[1] - solution[0] * middle / extent)
    if not np.isfinite([slope, shift, spread]).all() or slope <= 0.0 or spread > WORST_SPREAD:
        return None
    return Fit(slope, shift, spread, of_depth)


def metres(relative: F32, fit: Fit, farthest: float) -> F32:
    """Depth (h, w) in metres of what was fitted (h, w); 0 where it lies beyond ``farthest``."""
    fitted = fit.slope * relative.astype(np.float64) + fit.shift
    if fit.of_depth:
        return np.where((fitted > 0) & (fitted <= farthest), fitted, 0.0).astype(np.float32)
    usable = np.isfinite(fitted) & (fitted >= 1.0 / farthest)
    return np.where(usable, 1.0 / np.where(usable, fitted, 1.0), 0.0).astype(np.float32)


class PairedNetwork:
    """A relative network in the metres of a metric one; the metric one's answer where they don't fit.

    The scale, and so ``bias_sigma``, is the metric network's. ``counters["unpaired"]`` counts the images
    on which the metric network stood alone.
    """

    def __init__(self, relative: OnnxNetwork, metric: OnnxNetwork) -> None:
        """Raises ModelError unless the first is a relative and the second a metric network."""
        if relative.card.has_metres:
            raise ModelError(f"nested: {relative.name} has metres; the first network must be a relative one")
        if not metric.card.has_metres:
            raise ModelError(f"nested: {metric.name} has no metres; the second network must be a metric one")
        self._relative, self._metric = relative, metric
        self.card = metric.card
        self.name = f"nested:{relative.name},{metric.name}"
        self.identity = f"nested:{relative.identity},{metric.identity}"
        self.bias_sigma = metric.bias_sigma
        self.dsug = relative.dsug  # fitted to the confidence, which is the relative network's
        self.provider = ", ".join(dict.fromkeys((relative.provider, metric.provider)))
        self.counters: dict[str, int] = {"unpaired": 0}
        # Of the last images: whether the two did fit, or would have, were the depth of the other kind.
        self._fits: deque[tuple[bool, bool]] = deque(maxlen=_RECENT)
        for part in (relative, metric):
            for name, count in part.counters.items():
                self.counters[name] = self.counters.get(name, 0) + count

    @property
    def doubt(self) -> str:
        """What is wrong with them as a pair, in words; empty while they fit in half of the last images."""
        seen, fitted = len(self._fits), sum(fits for fits, _ in self._fits)
        if seen < _TELLING or 2 * fitted >= seen:
            return ""
        relative, metric = self._relative, self._metric
        said = f"{relative.name} fits {metric.name} in {fitted} of {seen} images: {metric.name} stands alone"
        if 2 * sum(otherwise for _, otherwise in self._fits) <= seen:
            return f"{said} in the others"
        other = INVERSE_RELATIVE if relative.card.depth_kind == RELATIVE else RELATIVE
        return f"{said}; with depth_kind: {other} in its card it would fit (docs/MODELS.md)"

    def infer(self, rgb: NDArray[np.uint8], camera: Camera) -> Prediction:
        """As :meth:`OnnxNetwork.infer`; the confidence is the relative network's, none where that failed.

        The descriptor is always the relative network's, or always the metric one's where the relative one
        has none: neither confidences nor descriptors of two networks can be compared.
        """
        metric = self._metric.infer(rgb, camera)
        own = self._relative.card.descriptor_output or self._relative.card.descriptor_layer
        try:
            raw, _ = self._relative.raw(rgb)
        except Exception as error:  # native code raises anything, and the metric answer is there
            parts = self._relative.name, self._metric.name
            log.warning("%s fails, %s stands alone: %s", *parts, native_line(error))
            self._count(metric, paired=False)
            descriptor = no_descriptor() if own else metric.descriptor
            fault = error if self._relative.provider != CPU else None
            return replace(metric, confidence=no_confidence(), descriptor=descriptor, fault=fault)
        took = metric.inference_ms + raw.inference_ms
        descriptor = normalised(raw.descriptor) if own else metric.descriptor
        paired = self._pair(raw, metric) if metric.valid else None
        if paired is None:
            self._count(metric, paired=False, raw=raw)
            return replace(
                metric, confidence=no_confidence(), descriptor=descriptor, inference_ms=took
            )
        self._count(metric, paired=True)
        return replace(paired, descriptor=descriptor, inference_ms=took)

    def _count(self, metric: Prediction, paired: bool, raw: Prediction | None = None) -> None:
        if not metric.valid:  # nothing that could be fitted to
            return
        self.counters["unpaired"] += not paired
        is_depth = self._relative.card.depth_kind == RELATIVE
        self._fits.append((paired, raw is not None and _fit_of(raw, metric, not is_depth) is not None))

    def _pair(self, raw: Prediction, metric: Prediction) -> Prediction | None:
        is_depth = self._relative.card.depth_kind == RELATIVE
        fit = _fit_of(raw, metric, is_depth)
        if fit is None:
            return None
        # Beyond the farthest the metric network saw, inverse depth near zero blows up.
        values = raw.depth
        if is_depth:
            there = np.isfinite(values) & (values != 0 if fit.of_depth else values > _LEAST)
            known = np.where(there, values, np.float32(np.nan))
            values = known if fit.of_depth else (1.0 / known).astype(np.float32)
        farthest = 1.5 * float(np.percentile(metric.depth[metric.depth > 0], 99))
        depth = metres(values, fit, farthest)
        if self._metric.card.sky_output:  # what it takes for sky has no depth, whatever the other says there
            at = np.arange(depth.shape[1], dtype=np.float64), np.arange(depth.shape[0], dtype=np.float64)
            seen, inside = _at(*np.meshgrid(*at), raw.image_to_depth, metric)
            depth[inside & (seen == 0.0)] = 0.0
        paired = checked(replace(raw, depth=depth))
        return paired if paired.valid else None


def _fit_of(raw: Prediction, metric: Prediction, is_depth: bool) -> Fit | None:
    samples = _samples(raw.depth, raw.image_to_depth, metric)
    return fit_depth(*samples) if is_depth else fit_inverse_depth(*samples)


def _samples(relative: F32, image_to_relative: F64, metric: Prediction) -> tuple[F64, F64]:
    """Both networks' values at a grid of points common to their fields of view."""
    rows, columns = relative.shape
    x, y = np.meshgrid(np.linspace(0, columns - 1, GRID[0]), np.linspace(0, rows - 1, GRID[1]))
    z, inside = _at(x, y, image_to_relative, metric)
    values = relative[np.round(y).astype(int), np.round(x).astype(int)]
    return values[inside].astype(np.float64), z[inside].astype(np.float64)


def _at(x: F64, y: F64, image_to_relative: F64, metric: Prediction) -> tuple[F32, NDArray[np.bool_]]:
    """The metric network's depth at places (h, w) of the other's map, and which lie in its field of view."""
    a, b, c, d = image_to_relative
    e, f, g, h = metric.image_to_depth
    mx, my = e * (x - b) / a + f, g * (y - d) / c + h  # by way of the image
    inside = (mx >= 0) & (mx <= metric.depth.shape[1] - 1) & (my >= 0) & (my <= metric.depth.shape[0] - 1)
    # Nearest pixels: blending across the 0 of an invalid one would invent a depth.
    z = cv2.remap(metric.depth, mx.astype(np.float32), my.astype(np.float32), cv2.INTER_NEAREST)
    return np.asarray(z, np.float32), inside


def _line_through_thirds(d: F64, target: F64) -> F64:
    near, far = d >= np.percentile(d, 67), d <= np.percentile(d, 33)
    run = float(np.median(d[near]) - np.median(d[far]))
    slope = float(np.median(target[near]) - np.median(target[far])) / run if run > 0 else 0.0
    return np.array([slope, float(np.median(target)) - slope * float(np.median(d))])
