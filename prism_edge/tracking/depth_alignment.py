"""A network's depth brought into the map's unit, place by place.

A network's scale wavers from image to image, and within an image from object to object. Both show in the
ratio of the map's depths to the network's at triangulated points, and near such a point the ratio is much the
same. So an image gets one ratio (its median), bent towards what the points round a pixel say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prism_edge.geometry.poses import Array

MIN_ALIGNED = 20  # triangulated points that make an image's own ratio better than the filter's
MIN_ORDERED = 60  # that say whether near and far are where the network has them
FLAT = 0.08  # sigma of log depth: what has less has no near and far
ALWAYS_CREDIBLE_SPREAD = 0.15  # a scene of one depth says nothing against a network
LEAST_EXPLAINED = 0.8  # of the spread of log depth may be left in the ratio
REACH = 0.045  # of the image's size: how far a point's ratio holds
FAR_SHARE = 0.1  # weight of the kernel's tail, which reaches sqrt(8) times as far
MEDIAN_WEIGHT = 0.3  # of the image's own ratio, in points
LEAST_SIGMA = 0.05
TAIL = 0.05  # of the ratios, at either end, counts as wrong


@dataclass(frozen=True)
class Agreement:
    """How a network's depths of one keyframe go with those of its triangulated points."""

    units_per_metre: float  # median ratio
    informative: bool  # whether the network tells near from far
    spread: float  # of the log ratios


def agreement(map_depths: Array, network_depths: Array) -> Agreement:
    """Compare depths (n,) above 0 of the same points.

    A network that is at a loss (an indoor one outdoors, say) puts out much the same depth for all: the log
    ratio then scatters as widely as the log depths themselves. Its points would lie at a wrong place with
    confidence, and since triangulation favours near points, each keyframe's would be nearer than the last's.
    """
    log_depths = np.log(map_depths)
    ratios = log_depths - np.log(network_depths)
    bound = max(ALWAYS_CREDIBLE_SPREAD, LEAST_EXPLAINED * robust_sigma(log_depths))
    spread = robust_sigma(ratios)
    return Agreement(float(np.exp(np.median(ratios))), spread < bound, spread)


def order(map_depths: Array, network_depths: Array) -> float | None:
    """How alike a map and a network order points (n,) from near to far: rank correlation, -1 to 1.

    None of few points, or where either has them all much as far away.
    """
    if len(map_depths) < MIN_ORDERED:
        return None
    if min(float(np.log(depths).std()) for depths in (map_depths, network_depths)) < FLAT:
        return None
    of_map, of_network = (np.argsort(np.argsort(depths)) for depths in (map_depths, network_depths))
    return float(np.corrcoef(of_map, of_network)[0, 1])


def robust_sigma(values: Array) -> float:
    """Standard deviation by the median absolute deviation."""
    return 1.48 * float(np.median(np.abs(values - np.median(values))))


@dataclass(frozen=True)
class DepthAlignment:
    """The log ratio of map to network depth over one image, from its triangulated points."""

    pixels: Array  # (m, 2)
    offsets: Array  # (m,) log ratios less their median
    overall: Agreement
    reach: float  # pixels
    local_sigma: float  # of a log ratio where the points around can be asked
    far_sigma: float  # and where there are none

    @classmethod
    def of(
        cls, pixels: Array, map_depths: Array, network_depths: Array, image_size: tuple[int, int]
    ) -> DepthAlignment:
        """From triangulated points (m,): pixels (m, 2), depths in map units and the network's in metres."""
        overall = agreement(map_depths, network_depths)
        offsets = np.log(map_depths / network_depths) - np.log(overall.units_per_metre)
        # Not by the median deviation: a minority of the image may well have a ratio of its own.
        offsets = np.clip(offsets, *np.quantile(offsets, (TAIL, 1.0 - TAIL)))
        reach = REACH * float(np.sqrt(image_size[0] * image_size[1]))
        weights = _kernel(pixels, pixels, reach)
        np.fill_diagonal(weights, 0.0)
        left = offsets - _mean(weights, offsets)[0]
        return cls(pixels, offsets, overall, reach, _rms(left), _rms(offsets))

    def at(self, pixels: Array) -> tuple[Array, Array]:
        """Map units a metre of network depth (n,) at pixels (n, 2), and its log sigma (n,)."""
        mean, share = _mean(_kernel(pixels, self.pixels, self.reach), self.offsets)
        sigma = share * self.local_sigma + (1.0 - share) * self.far_sigma
        return self.overall.units_per_metre * np.exp(mean), np.maximum(sigma, LEAST_SIGMA)


def _kernel(at: Array, of: Array, reach: float) -> Array:
    # Column by column and in single precision: this is most of what a keyframe's seeds cost.
    (x, y), (of_x, of_y) = (at / reach).astype(np.float32).T, (of / reach).astype(np.float32).T
    squared = np.subtract.outer(x, of_x) ** 2
    squared += np.subtract.outer(y, of_y) ** 2
    tail = np.exp(squared / np.float32(-16.0))
    near = tail * tail
    near *= near
    near *= near  # exp(-d^2 / (2 reach^2))
    weights: Array = near + FAR_SHARE * tail
    return weights


def _mean(weights: Array, offsets: Array) -> tuple[Array, Array]:
    """Weighted means (n,), drawn towards 0, and by how much (n,) the points were heard, in [0, 1)."""
    total = weights.sum(axis=1)
    share = total / (MEDIAN_WEIGHT + total)
    return weights @ offsets / (MEDIAN_WEIGHT + total), share


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
