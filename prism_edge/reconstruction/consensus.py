"""What several keyframes say of the same surface: who agrees, who sees through it, and their mean.

A depth map alone is wrong by a tenth and more, and differently from each place: laid one over another, such
maps show each wall several times. So a pixel counts where other keyframes see the same surface there, at the
mean of what they say; and not where the gate (paper, section 3.2) takes it for something that moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array, inverse, transform
from prism_edge.reconstruction.look import Look, between_four, surface
from prism_edge.scale.gate import Floats, GateParameters, combined, spatial_uncertainty, weigh

LEAST_WEIGHT = 0.5  # of the gate, at which u is tau
_NEAREST = 1e-3  # m before a camera


@dataclass(frozen=True)
class Consensus:
    """Of each pixel (h, w) of a depth map."""

    depth: NDArray[np.float32]  # metres, the mean of those that agree; 0 for none
    agreeing: NDArray[np.int64]  # keyframes that see this surface, its own among them
    through: NDArray[np.int64]  # those that see something behind it in its place
    weights: Floats  # the gate's, in [0, 1]

    def kept(self, least: int) -> NDArray[np.bool_]:
        """Pixels (h, w) that ``least`` keyframes agree on, more than see through, and the gate trusts."""
        by_vote = (self.agreeing >= least) & (self.agreeing > self.through)
        return by_vote & (self.depth > 0) & (self.weights >= LEAST_WEIGHT)


def consensus(
    look: Look, others: Sequence[Look], tolerance: float, gate: GateParameters | None
) -> Consensus:
    """Hold a keyframe's depth to that of ``others``, which see some of the same.

    Depths agree that differ by no more than ``tolerance`` (log). ``gate`` None leaves the gate open.
    """
    shape = look.view.depth.shape
    agreeing = np.ones(shape, np.int64)
    through, heard = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    total, differing = np.zeros(shape), np.zeros(shape)
    hidden = tolerance if gate is None else max(gate.tau, tolerance)
    points = surface(look.view)
    for other in others:
        ratios = _log_ratios(look, points, other)
        agrees = np.abs(ratios) <= tolerance  # not nan either
        agreeing += agrees
        through += ratios > tolerance
        total += np.where(agrees, ratios, 0.0)
        says = ratios >= -hidden
        heard += says
        differing += np.where(says, np.abs(ratios), 0.0)
    depth = (look.view.depth * np.exp(total / agreeing)).astype(np.float32)
    weights: Floats = np.ones(shape)
    if gate is not None:
        temporal = np.where(heard > 0, differing / np.maximum(heard, 1), np.nan)
        spatial = np.full(shape, np.nan)
        if look.view.confidence.size:
            spatial = np.asarray(spatial_uncertainty(look.view.confidence))
        weights = weigh(combined(spatial, temporal, gate.alpha), gate)
    return Consensus(depth, agreeing, through, weights)


def _log_ratios(look: Look, points: Array, other: Look) -> Array:
    """log(depth that ``other`` has at ``look``'s points (h, w, 3) / their depth there), (h, w); nan: none."""
    other_from_here = inverse(other.view.world_from_camera) @ look.view.world_from_camera
    seen = transform(other_from_here, points.reshape(-1, 3))
    before = seen[:, 2] > _NEAREST
    seen = np.where(before[:, None], seen, (0.0, 0.0, 1.0))
    pixels = np.where(before[:, None], other.view.camera.project(seen), -10.0)
    shape = look.view.depth.shape
    x, y = (np.clip(p, -10.0, 1e6).astype(np.float32).reshape(shape) for p in pixels.T)
    depth = between_four(other.view.depth, x, y)
    there = (depth > 0) & before.reshape(shape) & (look.view.depth > 0)
    return np.where(there, np.log(np.where(there, depth, 1.0) / seen[:, 2].reshape(shape)), np.nan)
