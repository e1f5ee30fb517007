"""Whether metres can be metres: a network that puts out millimetres passes every other check."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prism_edge.depth.prediction import F32

NEAREST_M, FARTHEST_M = 0.05, 300.0  # between them the median of what any camera on a robot looks at


@dataclass(frozen=True)
class Range:
    """Least, median and most of a depth map, metres."""

    least: float
    median: float
    most: float

    def __str__(self) -> str:
        return f"{_figure(self.least)} to {_figure(self.most)} m, median {_figure(self.median)} m"

    @property
    def doubt(self) -> str:
        """What is wrong with it as metres, in words; empty for nothing."""
        if NEAREST_M <= self.median <= FARTHEST_M:
            return ""
        return (
            f"a median depth of {_figure(self.median)} m is not within {NEAREST_M:g} and {FARTHEST_M:g} m: "
            "is the output in metres? depth_scale in its card makes metres of it (docs/MODELS.md)"
        )


def range_of(depth: F32) -> Range | None:
    """The range of the pixels of a map (h, w) that have depth, others being 0; None where none has."""
    there = depth[depth > 0]
    if not there.size:
        return None
    return Range(float(there.min()), float(np.median(there)), float(there.max()))


def _figure(metres: float) -> str:
    """Three digits, and no exponent of what is large."""
    return f"{metres:.3g}" if metres < 1000 else f"{metres:.0f}"
