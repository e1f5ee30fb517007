"""What each keypoint weighs in the scale's least squares: the gate's word, and the tracker's on its point."""

from __future__ import annotations

import numpy as np

from prism_edge.messages import F32, Keyframe
from prism_edge.scale.gate import Floats

LEAST_TRUST = 0.05  # of a sample's weight: points of which nothing good is known still say something
SHUT = 10  # keyframes in a row that the gate leaves less of: it is the gate's own figures that are wrong


def sample_trust(keyframe: Keyframe, gate_weights: Floats) -> F32:
    """Weight in [0, 1] of each keypoint of a keyframe."""
    return np.asarray(opened(gate_weights) * _relative_trust(keyframe), np.float32)


def opened(gate_weights: Floats) -> Floats:
    """The gate's weights (n,), all raised alike where half of them would be below ``LEAST_TRUST``; at most 1.

    A gate that is shut for all of an image says little of any one pixel. Were it taken at its word, whose
    tau and T are another network's, there would be no scale at all.
    """
    if len(gate_weights) == 0 or not is_shut(gate_weights):
        return gate_weights
    half = max(float(np.median(gate_weights)), float(np.finfo(np.float32).tiny))
    return np.minimum(np.asarray(gate_weights, np.float64) * (LEAST_TRUST / half), 1.0)


def is_shut(gate_weights: Floats) -> bool:
    """Whether a gate leaves next to nothing of half of the pixels (n,), of which there are some."""
    return bool(np.median(gate_weights) < LEAST_TRUST)


class ShutGate:
    """Notices a gate that is shut for one keyframe after another."""

    def __init__(self) -> None:
        self._in_a_row = 0

    def see(self, gate_weights: Floats) -> None:
        """The weights (n,) of a keyframe that was gated."""
        if len(gate_weights):
            self._in_a_row = self._in_a_row + 1 if is_shut(gate_weights) else 0

    @property
    def doubt(self) -> str:
        """What is to be said of that, in words; empty for nothing."""
        if self._in_a_row < SHUT:
            return ""
        return (
            f"the uncertainty gate leaves less than {LEAST_TRUST:.0%} of half of each image: "
            "its tau and T seem to be another network's (tools/fit_gate.py finds a network's own)"
        )


def _relative_trust(keyframe: Keyframe) -> F32:
    """What the tracker thinks of each keypoint's point, the best as 1; all alike where it says nothing."""
    trust = np.nan_to_num(keyframe.trust, nan=0.0, posinf=0.0, neginf=0.0)
    if len(trust) != len(keyframe.pixels) or not (trust > 0).any():
        return np.ones(len(keyframe.pixels), np.float32)
    return np.asarray(np.maximum(trust / trust.max(), LEAST_TRUST), np.float32)
