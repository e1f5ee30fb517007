"""Keypoints spread over the image: of what clusters, the strongest stay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prism_edge.tracking.point_table import Index
from prism_edge.tracking.sorting import order_of

CELL = 32  # pixels a side
CROWD = 3.0  # times a cell's even share of what is wanted: no cell has more
ENOUGH = 0.6  # of the least that is wanted: below it crowds are better than nothing


def spread(
    pixels: NDArray[np.float32],
    strength: NDArray[np.uint16],
    shape: tuple[int, ...],
    wanted: int,
    least: int,
) -> Index:
    """Choose at most ``wanted`` of the keypoints (n, 2) of an image (height, width), best places first.

    Every cell's best, then every cell's second best, and so on until there are enough. A textured thing in
    a bare room would still have most of them, as no other cell has so many; if it moves, or its depth is
    wrong, so is the pose. So no cell has more than CROWD times its share, unless ENOUGH of ``least`` would
    not be reached.
    """
    if len(pixels) == 0:
        return np.zeros(0, np.intp)
    columns, rows = shape[1] // CELL + 1, shape[0] // CELL + 1
    at = (pixels * (1.0 / CELL)).astype(np.intp)
    cell = at[:, 1] * columns + at[:, 0]
    strongest = int(strength.max())
    # Strongest first, of like ones by cell; from there on whatever is sorted keeps that order within itself.
    order = order_of(cell, columns * rows)
    order = order.take(order_of(strongest - strength.take(order), strongest + 1))
    rank = _rank_within(cell.take(order), columns * rows)
    ranked = order_of(rank, len(rank))
    uncrowded = int(np.count_nonzero(rank < CROWD * wanted / (columns * rows)))
    chosen: Index = order.take(ranked[: min(max(uncrowded, int(ENOUGH * least)), wanted)])
    return chosen


def _rank_within(cell: Index, cells: int) -> Index:
    """How many of the same cell come before each (n,)."""
    order = order_of(cell, cells)
    cell = cell.take(order)
    begins = np.ones(len(cell), bool)
    np.not_equal(cell[1:], cell[:-1], out=begins[1:])
    rank = np.empty(len(cell), np.intp)
    rank[order] = np.arange(len(cell)) - np.flatnonzero(begins).take(np.cumsum(begins) - 1)
    return rank
