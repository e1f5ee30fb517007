"""Dynamic scene uncertainty gating: how far each pixel of a keyframe is trusted (DSUG; paper, section 3.2).

    u = alpha u_spatial + (1 - alpha) u_temporal,   w = sigmoid((tau - u) / T),   Omega = w / sigma_0^2

u_spatial is the network's confidence turned round, where there is one. u_temporal is by how much (in the log,
hence relative) an earlier keyframe's depth differs from what this keyframe's depth predicts there: poses are
compensated, the pair's median ratio is taken out first, since a network's scale wavers from image to image,
and where the earlier camera saw something *nearer* the place was hidden from it, which says nothing. What
remains is depth noise, and places that the earlier camera saw through: something has moved in since.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.field_of_view import in_image
from prism_edge.geometry.poses import Array, inverse, transform
from prism_edge.scale.samples import Floats

GRID = 24  # pixels across and down that a pair's median ratio is taken over
MIN_COMMON = 40  # of them that must be seen by both
_NEAREST = 1e-3  # map units before a camera
_PLACES = 64  # keyframes whose poses are remembered: as many as may be waiting for their depth


@dataclass(frozen=True)
class GateParameters:
    """tau and T belong to a network and are fitted on static data (tools/fit_gate.py); alpha is a choice."""

    alpha: float
    tau: float
    temperature: float


@dataclass(frozen=True)
class DepthView:
    """One keyframe's depth map, and where it was seen from. ``units_per_metre`` is of this map alone."""

    keyframe: int
    world_from_camera: Array  # (4, 4), map units
    camera: Camera
    depth: Floats  # (h, w) metres, 0 where invalid
    image_to_depth: Array  # (4,), of raw pixels
    confidence: Floats  # (h, w), or (0, 0) for none
    units_per_metre: float

    def at(self, raw: Array) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
        """Row and column of the depth pixel at each raw pixel (n, 2), and which lie on the map."""
        return nearest(self.depth.shape, self.image_to_depth, raw)


@dataclass(frozen=True)
class Gated:
    """Uncertainty (n,) of each pixel, nan where nothing is known of it, and its weight (n,) in [0, 1]."""

    uncertainty: Floats
    weights: Floats


def nearest(
    shape: tuple[int, ...], image_to_depth: Array, raw: Array
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Row and column of a depth map of a ``shape`` at each raw pixel (n, 2), and which lie on it."""
    height, width = shape
    x = raw[:, 0] * image_to_depth[0] + image_to_depth[1]
    y = raw[:, 1] * image_to_depth[2] + image_to_depth[3]
    inside = (x >= -0.5) & (y >= -0.5) & (x < width - 0.5) & (y < height - 0.5)
    column = np.rint(np.where(inside, x, 0.0)).astype(np.intp)
    row = np.rint(np.where(inside, y, 0.0)).astype(np.intp)
    return row, column, inside


def weigh(uncertainty: Floats, parameters: GateParameters) -> Floats:
    """w = sigmoid((tau - u) / T); 1 where u is unknown (nan), as nothing is held against it."""
    exponent = (uncertainty - parameters.tau) / parameters.temperature
    weights = 1.0 / (1.0 + np.exp(np.clip(exponent, -50.0, 50.0)))
    return np.asarray(np.where(np.isnan(uncertainty), 1.0, weights))


def spatial_uncertainty(confidence: Floats) -> Floats:
    """Confidence turned round, in [0, 1]: 1 / c for open-ended confidence (1 + exp, as Depth Anything 3's),
    1 - c for a probability. nan where it is not finite, where an open-ended one is 0 or less, which such
    networks mask pixels with, and everywhere where no pixel is above 0."""
    known = np.isfinite(confidence)
    positive = known & (confidence > 0)
    if not positive.any():
        return np.full(np.shape(confidence), np.nan)
    safe = np.where(known, confidence, 1.0)
    if is_open_ended(confidence[positive]):
        return np.asarray(np.where(positive, 1.0 / np.maximum(safe, 1.0), np.nan))
    return np.asarray(np.where(known, 1.0 - np.clip(safe, 0.0, 1.0), np.nan))


def is_open_ended(positive: Floats) -> bool:
    """Whether of confidences (n,) above 0 none is below 1, or most are above it.

    Upsampling takes some probabilities there, too.
    """
    above = positive > 1.0
    return bool(above.any() and (positive.min() >= 1.0 or np.mean(above) > 0.5))


def combined(spatial: Floats, temporal: Floats, alpha: float) -> Floats:
    """u = alpha u_spatial + (1 - alpha) u_temporal; where one is unknown the other, nan where both are."""
    both = alpha * spatial + (1.0 - alpha) * temporal
    return np.asarray(np.where(np.isnan(spatial), temporal, np.where(np.isnan(temporal), spatial, both)))


def log_discrepancy(now: DepthView, before: DepthView, pixels: Array) -> Array:
    """log of (depth that ``before`` has) over (depth that ``now`` predicts there), for raw pixels (n, 2).

    nan where either has no depth or the place lies outside of the earlier image. The pair's median, taken
    over a grid of the image, is removed. All nan where the two have too little in common.
    """
    probes = _grid(now.camera)
    ratios = _log_ratios(now, before, np.concatenate([probes, pixels]))
    common = ratios[: len(probes)]
    common = common[np.isfinite(common)]
    if len(common) < MIN_COMMON:
        return np.full(len(pixels), np.nan)
    return ratios[len(probes) :] - float(np.median(common))


def temporal_uncertainty(
    now: DepthView, earlier: list[DepthView], pixels: Array, hidden: float
) -> Floats:
    """u_temporal (n,) of raw pixels: the mean |log discrepancy| from ``earlier`` views; nan for none.

    Where an earlier view saw something nearer by more than ``hidden`` (log), it says nothing.
    """
    total, count = np.zeros(len(pixels)), np.zeros(len(pixels))
    for before in earlier:
        discrepancy = log_discrepancy(now, before, pixels)
        says = discrepancy >= -hidden  # not nan either
        total += np.where(says, np.abs(discrepancy), 0.0)
        count += says
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1.0), np.nan))


class DepthGate:
    """Remembers the last few depth views of a map and gates the next."""

    def __init__(self, memory: int) -> None:
        """``memory``: how many earlier keyframes a new one is compared with."""
        self._views: deque[DepthView] = deque(maxlen=memory)
        self._places: dict[int, Array] = {}  # world_from_camera of keyframes, also of those without a view

    def assess(self, view: DepthView, pixels: Array, parameters: GateParameters) -> Gated:
        """Uncertainty and weight of raw pixels (n, 2) of a view, against those remembered."""
        temporal = temporal_uncertainty(view, list(self._views), pixels, parameters.tau)
        spatial = np.full(len(pixels), np.nan)
        if view.confidence.size:
            row, column, inside = view.at(pixels)
            spatial = np.where(inside, spatial_uncertainty(view.confidence)[row, column], np.nan)
        uncertainty = combined(spatial, temporal, parameters.alpha)
        return Gated(uncertainty, weigh(uncertainty, parameters))

    def remember(self, view: DepthView) -> None:
        """Keep a view for those to come; the oldest goes."""
        self._views.append(view)
        self.place(view.keyframe, view.world_from_camera)

    def place(self, keyframe: int, world_from_camera: Array) -> None:
        """Keep a keyframe's pose: the next one will say where it lies by then."""
        self._places[keyframe] = world_from_camera
        while len(self._places) > _PLACES:
            del self._places[next(iter(self._places))]

    def placed(self, keyframe: int) -> Array | None:
        """Where a keyframe lies by now; None for one that is not remembered."""
        return self._places.get(keyframe)

    def rebase(self, keyframe: int, world_from_camera: Array) -> None:
        """A keyframe turns out to lie elsewhere (a correction of the map): all views move along with it."""
        if keyframe in self._places:
            motion = world_from_camera @ inverse(self._places[keyframe])
            self._places = {k: motion @ pose for k, pose in self._places.items()}
            moved = [replace(v, world_from_camera=motion @ v.world_from_camera) for v in self._views]
            self._views = deque(moved, self._views.maxlen)

    def copy(self) -> DepthGate:
        """A gate with the same memory, that keeps it."""
        other = DepthGate(self._views.maxlen or 1)
        other._views.extend(self._views)
        return other


def image_pixels(view: DepthView) -> Array:
    """Raw image pixels (h w, 2) of every pixel of a view's depth map, row by row."""
    height, width = view.depth.shape
    a, b, c, d = view.image_to_depth
    x, y = np.meshgrid((np.arange(width) - b) / a, (np.arange(height) - d) / c)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _grid(camera: Camera) -> Array:
    x = (np.arange(GRID) + 0.5) * camera.width / GRID
    y = (np.arange(GRID) + 0.5) * camera.height / GRID
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _log_ratios(now: DepthView, before: DepthView, pixels: Array) -> Array:
    """log(depth seen before / depth predicted), each in map units by its own view's scale; nan for none.

    Of the 3 x 3 pixels round the place the depth nearest to the prediction counts, so that being a pixel
    off at an edge is no discrepancy.
    """
    row, column, inside = now.at(pixels)
    z = now.depth[row, column].astype(np.float64) * now.units_per_metre
    usable = inside & (z > 0) & np.isfinite(z)
    rays = now.camera.normalise(pixels)
    z_safe = np.where(usable, z, 1.0)
    points = np.column_stack([rays * z_safe[:, None], z_safe])
    seen = transform(inverse(before.world_from_camera) @ now.world_from_camera, points)
    predicted = seen[:, 2]
    usable &= predicted > _NEAREST
    safe = np.where(usable, predicted, 1.0)
    ideal = before.camera.to_pixels(seen[:, :2] / safe[:, None])
    if not before.camera.is_ideal:  # from far outside a lens that folds over leads back into its image
        usable &= in_image(before.camera, ideal)
    raw = before.camera.distort_pixels(ideal)
    row, column, inside = before.at(np.where(usable[:, None], raw, -1e6))
    usable &= inside
    height, width = before.depth.shape
    best = np.full(len(pixels), np.nan)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            depth = before.depth[np.clip(row + dy, 0, height - 1), np.clip(column + dx, 0, width - 1)]
            valid = usable & (depth > 0) & np.isfinite(depth)
            ratio = np.log(np.where(valid, depth, 1.0) * before.units_per_metre / safe)
            closer = valid & ~(np.abs(ratio) >= np.abs(best))
            best = np.where(closer, ratio, best)
    return best
