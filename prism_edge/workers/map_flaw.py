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
    keyframes, has_points = _column(arrays, "keyframes").size, (_column(arrays, "seen") >= 0).any()
    return size_flaw(keyframes, bool(has_points)) or pyramid_flaw(arrays, tracking)


def size_flaw(keyframes: int, has_points: bool) -> str:
    """Why a map is too small to be gone on in; empty where it is not."""
    if keyframes < LEAST_KEYFRAMES:
        return f"the map has too few keyframes, {keyframes}; a new one is as soon made"
    return "" if has_points else "the map has no points"


def pyramid_flaw(arrays: Arrays, tracking: TrackingConfig) -> str:
    """Why the tracker's image pyramid does not fit the one a map was made with; empty where it does."""
    if (_column(arrays, "scale_factors") != tracking.scale_factor).any():
        return f"the map was made with another tracking.scale_factor than {tracking.scale_factor:g}"
    if (_column(arrays, "octaves") >= tracking.levels).any():
        return f"the map was made with more tracking.levels than {tracking.levels}"
    return ""


def _column(arrays: Arrays, name: str) -> NDArray[Any]:
    return arrays.get(name, np.zeros(0))  # that one is missing is for stored_map.py to say
