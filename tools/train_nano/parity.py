"""By how much a written network's answer differs from the trained one's."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def relative_difference(answer: NDArray[Any], expected: NDArray[Any]) -> float:
    """The largest difference relative to the largest expected value; infinite where either is not finite."""
    if answer.shape != expected.shape or not (np.isfinite(answer).all() and np.isfinite(expected).all()):
        return float("inf")
    largest = max(float(np.abs(expected).max()), float(np.finfo(np.float32).tiny))
    return float(np.abs(answer - expected).max()) / largest
