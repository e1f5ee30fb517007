"""How far map points are trusted to stand still.

What moves is seldom found in the same place for long: its points fail and are made anew. So a point earns
its weight in a pose by the time for which it has been found consistent (squared, relative to
``proven_after_s``), times what the uncertainty gate thinks of it, which counts the less the longer the point
has stood: what geometry has proven, a network that is unsure of its depth does not refute. Among points that
are all new, as in a part of the scene that has just come into view, the weights are alike and change nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array
from prism_edge.tracking.point_table import Index, PointTable

LEAST_WEIGHT = 0.05
PROVEN, MIN_PROVEN = 0.5, 6  # trust in a point; what a pose needs


def trust(table: PointTable, rows: Index, now_ns: int, proven_after_s: float) -> Array:
    """Weight (n,) in (0, 1] of each point at a time; with ``proven_after_s`` 0 age says nothing."""
    if proven_after_s <= 0.0:
        return np.maximum(table.weight[rows], LEAST_WEIGHT)
    age = (now_ns - table.born_ns[rows]) * (1e-9 / proven_after_s)
    share = np.minimum(np.maximum(age, 0.0), 1.0)  # a third of np.clip's time
    gate = table.weight[rows]
    return np.maximum((gate + (1.0 - gate) * share) * share * share, LEAST_WEIGHT)


def proven(table: PointTable, rows: Index, now_ns: int, proven_after_s: float) -> NDArray[np.bool_]:
    """Which points (n,) have stood their time."""
    mask: NDArray[np.bool_] = trust(table, rows, now_ns, proven_after_s) > PROVEN
    return mask
