"""The fisheye lens (Kannala and Brandt's, as OpenCV has it): radius in the image by the angle off the axis.

radius = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8). Beyond the views that it was fitted
to it may cease to grow: what lies there belongs to no ray.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from prism_edge.geometry.poses import Array

WIDEST = 1.55  # rad: tan() of a right angle is no point of a plane
_ITERATIONS = 60
SETTLED = 1e-14  # focal lengths
_NOTHING = 1e-12  # what bends no ray by as much as that
Coefficients = tuple[float, ...]  # k1..k4, as many as there are


def radius_of(theta: Array, k: Coefficients) -> Array:
    """Distance (n,) from the principal point, in focal lengths, of rays ``theta`` (n,) off the axis, rad."""
    k1, k2, k3, k4 = (*k, *(0.0,) * (4 - len(k)))
    t2 = theta * theta
    return theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))


def theta_of(radius: Array, k: Coefficients) -> Array:
    """The angles (n,): :func:`radius_of` undone; what no ray comes to goes to the end of what grows."""
    k1, k2, k3, k4 = (*k, *(0.0,) * (4 - len(k)))
    high = np.full(len(radius), min(folds_at(k), WIDEST))
    radius = np.minimum(radius, radius_of(high, k))
    low, theta, step = np.zeros(len(radius)), np.minimum(radius, high), high
    for _ in range(_ITERATIONS):
        beyond = radius_of(theta, k) - radius
        settled = np.abs(beyond) < SETTLED
        if settled.all():
            break
        # Newton's step, and half of what is left where that would leave it, or is not half the one before:
        # slopes go down to nothing, and between a flat and a steep place steps go to and fro.
        low, high = np.where(beyond < 0.0, theta, low), np.where(beyond > 0.0, theta, high)
        t2 = theta * theta
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        newton = theta - beyond / np.where(slope > 1e-9, slope, 1e-9)
        taken = (newton >= low) & (newton <= high) & (np.abs(newton - theta) < 0.5 * step)
        better = np.where(taken, newton, 0.5 * (low + high))
        theta, step = np.where(settled, theta, better), np.abs(better - theta)
    return theta


@lru_cache(maxsize=64)
def folds_at(k: Coefficients) -> float:
    """The angle, rad, where the radius ceases to grow; infinite where it never does."""
    k1, k2, k3, k4 = (*k, *(0.0,) * (4 - len(k)))
    slope = np.array([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])  # by theta^2
    roots = np.roots(np.where(np.abs(slope) < _NOTHING, 0.0, slope))  # to divide by next to nothing overflows
    squares = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
    return float(np.sqrt(squares.min())) if len(squares) else np.inf
