"""Log scale of one keyframe: robust weighted least squares in the log domain (paper, section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array
from prism_edge.scale.samples import Floats

HUBER = 1.345  # in sigmas: 95 % efficient on a Gaussian
_ITERATIONS = 20
_CONVERGED = 1e-6
_SIGMA_OF_MEDIAN = 1.48  # standard deviation of a Gaussian by its median absolute deviation


@dataclass(frozen=True)
class Observation:
    """Log scale as one keyframe shows it.

    ``point_variance`` averages out over keyframes at once; frame_sigma squared is shared by all pixels of the
    keyframe and, in part, by its neighbours in time; ``excess_variance`` is what this image adds to that.
    ``variance`` is their sum.
    """

    log_scale: float
    variance: float
    point_variance: float
    points: int
    excess_variance: float = 0.0


def weighted_least_squares(
    log_ratios: Array,
    patches: NDArray[np.int64],
    gate_weights: Floats,
    point_sigma: float,
    frame_sigma: float,
    min_points: int,
) -> Observation | None:
    """Minimises sum of Omega * huber(log_ratio - log_scale) with Omega = w / sigma_0^2 (eq. DSUG).

    ``log_ratios``, ``patches`` and ``gate_weights`` w in [0, 1] are (n,). A network errs alike over a patch
    of the image, so the pixels of one share a single sigma_0: each has Omega = w / (n_patch sigma_0^2). The
    variance is the larger of what sigma_0 and what the residuals say, over the effective number of patches
    (Kish), plus frame_sigma^2, and of that by as much more as the residuals scatter beyond sigma_0. None
    where fewer than ``min_points`` have any weight.
    """
    used = np.isfinite(log_ratios) & np.isfinite(gate_weights) & (gate_weights > 0.0)
    if np.count_nonzero(used) < max(min_points, 1):
        return None
    values = log_ratios[used]
    _, patch, crowd = np.unique(patches[used], return_inverse=True, return_counts=True)
    omega = np.clip(gate_weights[used], 0.0, 1.0) / crowd[patch] / point_sigma**2
    mean = _weighted_median(values, omega)
    robust = omega
    for _ in range(_ITERATIONS):
        residuals = np.abs(values - mean) / point_sigma
        robust = omega * np.minimum(1.0, HUBER / np.maximum(residuals, 1e-12))
        step = float(robust @ (values - mean) / robust.sum())
        mean += step
        if abs(step) < _CONVERGED:
            break
    by_patch = np.bincount(patch, weights=robust)
    effective = float(by_patch.sum() ** 2 / (by_patch @ by_patch))
    # gating all of an image down must not leave it as trusted as before: w scales the information itself
    effective *= float(omega.sum() * point_sigma**2 / len(crowd))
    scatter = float(robust @ (values - mean) ** 2 / robust.sum())
    point_variance = max(point_sigma**2, scatter) / effective
    # An image whose relative depth is off by twice as much as usual is as much more off in its scale.
    spread = _SIGMA_OF_MEDIAN * float(np.median(np.abs(values - mean)))  # about what is believed of it
    excess = frame_sigma**2 * max((spread / point_sigma) ** 2 - 1.0, 0.0)
    variance = point_variance + frame_sigma**2 + excess
    return Observation(mean, variance, point_variance, len(values), excess)


def plain_mean(
    log_ratios: Array, point_sigma: float, frame_sigma: float, min_points: int
) -> Observation | None:
    """The ablation 'wls': every point counts once, none is an outlier, and all are taken as independent."""
    values = log_ratios[np.isfinite(log_ratios)]
    if len(values) < max(min_points, 1):
        return None
    point_variance = point_sigma**2 / len(values)
    return Observation(float(values.mean()), point_variance + frame_sigma**2, point_variance, len(values))


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])
