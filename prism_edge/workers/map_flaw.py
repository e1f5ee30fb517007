"""Why a map that comes from elsewhere (a file, a journal, another process) can't be gone on in."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from prism_edge.backend.map_file import Arrays
from prism_edge.config import TrackingConfig

LEAST_KEYFRAMES = 2  # a map of fewer is as soon made anew


def map_flaw(arrays: Arrays, tracking: TrackingConfig) -> str:
    """Why the tracker could not go on in a map, in words; empty where it could."""
    count = _column(arrays, "keyframes").size
    if count < LEAST_KEYFRAMES:
        return f"the map has too few keyframes, {count}; a new one is as soon made"
    if not (_column(arrays, "seen") >= 0).any():
        return "the map has no points"
    return pyramid_flaw(arrays, tracking)


def pyramid_flaw(arrays: Arrays, tracking: TrackingConfig) -> str:
    """Why the tracker's image pyramid does not fit the one a map was made with; empty where it does."""
    if (_column(arrays, "scale_factors") != tracking.scale_factor).any():
        return f"the map was made with another tracking.scale_factor than {tracking.scale_factor:g}"
    if (_column(arrays, "octaves") >= tracking.levels).any():
        return f"the map was made with more tracking.levels than {tracking.levels}"
    return ""


def _column(arrays: Arrays, name: str) -> NDArray[Any]:
    return arrays.get(name, np.zeros(0))  # that one is missing is for stored_map.py to say
