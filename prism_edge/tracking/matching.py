"""Binary descriptors matched where geometry expects them; everything vectorised over candidate pairs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prism_edge.tracking.features import CELL, Features
from prism_edge.tracking.point_table import Index
from prism_edge.tracking.sorting import order_of

MATCH_DISTANCE, MATCH_RATIO, FARTHEST = 60, 0.8, 256
_ROWS = 32
_SHIFT = 40
_FAR = np.int64(1024) << _SHIFT  # beyond any distance of 256 bits


def hamming(a: NDArray[np.uint64], b: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Differing bits between rows of (n, 4) 64-bit words."""
    bits: NDArray[np.int64] = np.einsum("ij->i", np.bitwise_count(a ^ b), dtype=np.int64)
    return bits


def expand_ranges(starts: Index, stops: Index, owners: Index) -> tuple[Index, Index]:
    """Concatenated ranges [start, stop): (whose range it is, value), ordered by range."""
    lengths = stops - starts
    offset = np.cumsum(lengths)
    value = np.arange(offset[-1] if len(offset) else 0)
    offset -= lengths
    value += np.repeat(starts - offset, lengths)
    return np.repeat(owners, lengths), value


def candidate_pairs(
    features: Features, centres: NDArray[np.float64], radii: NDArray[np.float64]
) -> tuple[Index, Index]:
    """All (query, keypoint) pairs with the keypoint inside the query's square; grouped by query."""
    if len(centres) == 0:
        none = np.zeros(0, np.intp)
        return none, none
    at = np.ascontiguousarray(centres.T)
    last = np.array([[features.columns - 1], [features.rows - 1]], np.float64)
    (low_x, low_y), (high_x, high_y) = _cells(at - radii, last), _cells(at + radii, last)
    # Cells of one row lie side by side in ``order``, so each row of a square is a single range.
    owners, rows = expand_ranges(low_y, high_y + 1, np.arange(len(centres)))
    rows *= features.columns
    starts = features.cell_start.take(rows + low_x.take(owners))
    stops = features.cell_start.take(rows + (high_x + 1).take(owners))
    query, position = expand_ranges(starts, stops, owners)
    keypoint = features.order.take(position)
    offset = np.ascontiguousarray(features.pixels.T).take(keypoint, axis=1)
    offset -= at.take(query, axis=1)
    right, down = np.abs(offset, out=offset)
    inside = np.flatnonzero(np.maximum(right, down, out=right) <= radii.take(query))
    return query.take(inside), keypoint.take(inside)


def _cells(at: NDArray[np.float64], last: NDArray[np.float64]) -> Index:
    """Columns and rows (2, n) of the cells that pixels (2, n) are in; ``last`` (2, 1): there are no more."""
    at /= CELL
    # Not np.clip, which takes several times as long on so few numbers.
    return np.minimum(np.maximum(at, 0.0, out=at), last, out=at).astype(np.intp)


def best_pairs(
    query: Index,
    keypoint: Index,
    distance: NDArray[np.int64],
    max_distance: int,
    ratio: float,
) -> tuple[Index, Index]:
    """One keypoint for each query and one query for each keypoint; nearest pairs first.

    The pairs given are grouped by query. A pair needs a distance of at most ``max_distance`` and below
    ``ratio`` times the query's second best.
    """
    if len(query) == 0:
        return query, keypoint
    new = np.empty(len(query), bool)
    new[0] = True
    np.not_equal(query[1:], query[:-1], out=new[1:])
    first = np.flatnonzero(new)
    # Distance and place in one number, so that a minimum tells both; shifts, for division is slow.
    ranked = (distance << _SHIFT) + np.arange(len(query))
    best = np.minimum.reduceat(ranked, first)
    position = best & ((1 << _SHIFT) - 1)
    ranked[position] = _FAR
    second = np.minimum.reduceat(ranked, first) >> _SHIFT
    nearest = best >> _SHIFT
    good = (nearest <= max_distance) & (nearest < ratio * second)
    position = position.compress(good)
    # Of several queries that want one keypoint the nearest gets it.
    order = order_of(distance.take(position), FARTHEST + 1)
    position = position.take(order)
    query, keypoint = query.take(position), keypoint.take(position)
    if len(position) == 0:
        return query, keypoint
    # Backwards, so that of several the first is written last.
    places = np.arange(len(position))
    first_at = np.empty(int(keypoint.max()) + 1, np.intp)
    first_at[keypoint[::-1]] = places[::-1]
    mine = np.flatnonzero(first_at.take(keypoint) == places)
    return query.take(mine), keypoint.take(mine)


def match_projected(
    features: Features,
    centres: NDArray[np.float64],
    radii: NDArray[np.float64],
    octaves: NDArray[np.intp],
    descriptors: NDArray[np.uint64],
    max_distance: int,
    ratio: float,
    free: NDArray[np.bool_] | None = None,
) -> tuple[Index, Index]:
    """Match points expected at ``centres`` (m, 2) at pyramid level ``octaves`` to keypoints of one like it.

    ``free`` (n,) masks keypoints that may be matched. Returns (query, keypoint) index arrays.
    """
    query, keypoint = candidate_pairs(features, centres, radii)
    keep = np.abs(features.octaves.take(keypoint) - octaves.take(query)) <= 1
    if free is not None:
        keep &= free.take(keypoint)
    kept = np.flatnonzero(keep)
    query, keypoint = query.take(kept), keypoint.take(kept)
    # Whole rows: take() is several times as fast as an index in brackets.
    distance = hamming(descriptors.take(query, axis=0), features.descriptors.take(keypoint, axis=0))
    return best_pairs(query, keypoint, distance, max_distance, ratio)


def match_corners(a: Features, b: Features) -> tuple[Index, Index]:
    """Mutual nearest descriptors, near enough and clearly nearer than the next; indices into each."""
    if min(len(a), len(b)) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    distance = all_distances(a.descriptors, b.descriptors)
    rows = np.arange(len(a))
    best, back = distance.argmin(axis=1), distance.argmin(axis=0)
    nearest = distance[rows, best]
    distance[rows, best] = FARTHEST
    good = (nearest <= MATCH_DISTANCE) & (nearest < MATCH_RATIO * distance.min(axis=1)) & (back[best] == rows)
    return rows[good], best[good]


def all_distances(a: NDArray[np.uint64], b: NDArray[np.uint64]) -> NDArray[np.uint16]:
    """Differing bits (n, m) between all rows of (n, 4) and of (m, 4) 64-bit words."""
    distance = np.zeros((len(a), len(b)), np.uint16)
    columns = [np.ascontiguousarray(column) for column in b.T]
    # A few rows at a time, which stay in the cache: a fifth of the time.
    differing, count = np.empty((_ROWS, len(b)), np.uint64), np.empty((_ROWS, len(b)), np.uint8)
    for start in range(0, len(a), _ROWS):
        part = distance[start : start + _ROWS]
        for word, column in enumerate(columns):
            np.bitwise_xor(a[start : start + _ROWS, word, None], column, out=differing[: len(part)])
            part += np.bitwise_count(differing[: len(part)], out=count[: len(part)])
    return distance
