"""Undoing a purely radial lens: one unknown a point, where the general lens has two."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from prism_edge.geometry.poses import Array

ITERATIONS = 20
SETTLED = 1e-8  # of a step: what is left is about its square
MOST_INWARDS = 0.5  # of where a step begins: what is left of it at least
FLAT = 0.01  # least slope of a step: at the fold itself there is none


def undistort_radial(distorted: Array, k1: float, k2: float, k3: float) -> Array:
    """Coordinates (n, 2) on the plane z = 1 whose distortion by k1, k2 and k3 is ``distorted``.

    With R the squared radius as taken, a point lies at s times its own place, where
    s (1 + k1 R s^2 + k2 R^2 s^4 + k3 R^3 s^6) = 1: Newton's steps from s = 1. A strong lens folds over, and
    nothing is seen beyond: such a point is put on the fold, which comes nearest to it.
    """
    square = np.einsum("ij,ij->i", distorted, distorted)
    farthest = np.sqrt(_fold(k1, k2, k3) / np.maximum(square, 1e-18))
    scale = np.minimum(1.0, farthest)
    for _ in range(ITERATIONS):
        t = square * scale * scale
        error = scale * (1.0 + t * (k1 + t * (k2 + t * k3))) - 1.0
        slope = 1.0 + t * (3.0 * k1 + t * (5.0 * k2 + t * 7.0 * k3))
        # Where a lens is nearly flat at its fold, a step from there would leave the image.
        step = np.maximum(scale - error / np.maximum(slope, FLAT), MOST_INWARDS * scale)
        before, scale = scale, np.minimum(step, farthest)
        if np.abs(scale - before).max(initial=0.0) < SETTLED:
            break
    return distorted * scale[:, None]


@lru_cache(maxsize=64)
def _fold(k1: float, k2: float, k3: float) -> float:
    """Squared radius on the plane z = 1 at which what is farther out is seen no farther out; inf for none."""
    # Of 1 / t, as any of the coefficients may be 0 (next to 0, too).
    roots = np.roots((1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3))
    real = roots[np.abs(roots.imag) <= 1e-9 * np.abs(roots)].real
    largest = float(max(real, default=0.0))
    return 1.0 / largest if largest > 1e-9 else np.inf
