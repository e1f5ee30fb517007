"""What a network's answer is worth: metres where it gave some, and a plain word where it did not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from prism_edge.messages import F32

LEAST_VALID = 0.2  # share of pixels below which a depth map is no use
LEAST_SPREAD = 1e-4  # relative spread below which it is constant
PROBABILITY, OPEN = "probability", "open"  # kinds of confidence: 0 to 1, or 1 to infinity
LEAST_OPEN = np.nextafter(np.float32(1), np.float32(2))  # no probability, and as unsure as 1
LEAST_NORM = 1e-6  # of a descriptor that says anything


@dataclass(frozen=True)
class Prediction:
    """Metric depth of one image at the network's resolution; pixels without depth are 0.

    Image pixel (x, y) is at (a x + b, c y + d) of the map, ``image_to_depth`` = (a, b, c, d); under a
    cropping network parts of the image lie outside of it. (x, y) are raw pixels, lens distortion included,
    whatever the network was shown (straight.py); depth is z along the optical axis.
    ``fault`` is what an accelerator failed by where another network's answer stands all the same.
    """

    depth: F32  # (h, w) metres
    image_to_depth: NDArray[np.float64]  # (4,)
    confidence: F32  # (h, w) in the range of its kind, NaN where it is unknown; (0, 0) for none
    descriptor: F32  # (n,) of Euclidean norm 1, (0,) for none
    inference_ms: float
    valid: bool = True
    reason: str = ""
    fault: Exception | None = None


def no_confidence() -> F32:
    """The array that says that the network gives no confidence."""
    return np.zeros((0, 0), np.float32)


def in_its_range(confidence: F32, kind: str) -> F32:
    """Confidence (h, w) held to the range of its ``kind``, by which the gate knows it; as it is for no kind.

    A probability is in [0, 1]; an open-ended one above 1, or 0 where the network masks a pixel. NaN stays.
    """
    if kind == PROBABILITY:
        return np.clip(confidence, np.float32(0), np.float32(1))
    if kind == OPEN:
        return np.where(confidence <= 0, np.float32(0), np.maximum(confidence, LEAST_OPEN))
    return confidence


def no_descriptor() -> F32:
    """The array that says that the network gives no descriptor."""
    return np.zeros(0, np.float32)


def normalised(descriptor: F32) -> F32:
    """The descriptor (n,) at Euclidean norm 1; :func:`no_descriptor` where it is not finite or all zero."""
    values = descriptor.astype(np.float64)
    norm = float(np.linalg.norm(values))
    if not np.isfinite(norm) or norm < LEAST_NORM:
        return no_descriptor()
    return (values / norm).astype(np.float32)


def checked(prediction: Prediction) -> Prediction:
    """The prediction with unusable pixels set to 0, and marked invalid where too little is left.

    Unusable are NaN, infinities, zeros and negatives. A map with less than a fifth of usable pixels, or
    whose usable pixels are all alike, says nothing about the scene and becomes all 0.
    """
    depth = prediction.depth
    usable = np.isfinite(depth) & (depth > 0)
    share = float(np.mean(usable)) if usable.size else 0.0
    reason = ""
    if share < LEAST_VALID:
        reason = f"only {100 * share:.0f} % of the depth map is usable ({_commonest(depth)})"
    else:
        values = depth[usable].astype(np.float64)
        if np.std(values) < LEAST_SPREAD * np.mean(values):
            reason = f"the depth map is constant ({float(values[0]):.3g} m)"
    most = float(np.finfo(np.float32).max)  # surer than that is no less sure
    confidence = np.nan_to_num(prediction.confidence, nan=0.0, posinf=most, neginf=0.0)
    return replace(
        prediction,
        depth=np.zeros_like(depth) if reason else np.where(usable, depth, np.float32(0)),
        confidence=confidence,
        descriptor=normalised(prediction.descriptor),
        valid=not reason,
        reason=reason,
    )


def _commonest(depth: F32) -> str:
    if not depth.size:
        return "it is empty"
    counts = {
        "NaN": int(np.sum(np.isnan(depth))),
        "infinite": int(np.sum(np.isinf(depth))),
        "zero": int(np.sum(depth == 0)),
        "negative": int(np.sum(np.isfinite(depth) & (depth < 0))),
    }
    return f"most of the rest {max(counts, key=lambda word: counts[word])}"
