"""Of many views of a board, those that differ most (pure)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from prism_edge.calibration.board import Board, View
from prism_edge.geometry.poses import Array

DIFFERENT = 0.06  # of the image's width, by which the board's outline moves on average


def outline(board: Board, view: View) -> Array | None:
    """Where the board's outermost corners (4, 2) lie in the image, seen or not; None if it can't be told."""
    mapped, _ = cv2.findHomography(board.points[view.corners, :2], view.pixels)
    if mapped is None:
        return None
    return cv2.perspectiveTransform(board.outline[None], mapped)[0]


def distinct(outlines: Sequence[Array], width: int, most: int) -> list[int]:
    """Indices of at most ``most`` outlines that differ, the most different first.

    Farthest point first: each one taken is the one whose nearest neighbour among those taken is farthest.
    """
    if not outlines:
        return []
    flat = np.array(outlines).reshape(len(outlines), 8) / width
    taken = [0]
    nearest = _distances(flat, flat[0])
    while len(taken) < min(most, len(flat)):
        farthest = int(np.argmax(nearest))
        if nearest[farthest] < DIFFERENT:
            break
        taken.append(farthest)
        nearest = np.minimum(nearest, _distances(flat, flat[farthest]))
    return taken


def _distances(flat: Array, one: Array) -> Array:
    """Mean motion of the four corners, in widths; a chessboard may be seen either way round."""
    corners, reference = flat.reshape(-1, 4, 2), one.reshape(4, 2)
    straight = np.linalg.norm(corners - reference, axis=2).mean(axis=1)
    turned = np.linalg.norm(corners - np.roll(reference, 2, axis=0), axis=2).mean(axis=1)
    return np.minimum(straight, turned)
