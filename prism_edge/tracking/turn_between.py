"""How a camera turned between two frames, by their corners alone: where there is no map to tell."""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, so3_exp, so3_log
from prism_edge.tracking.features import Features
from prism_edge.tracking.matching import match_corners
from prism_edge.tracking.triangulation import rays

LEAST_CORNERS = 30  # that agree
AGREEING_PX, NARROWEST_PX, ITERATIONS = 3.0, 0.3, 10
SPREAD = 1e-9  # of the corners: about what all lie on nothing is said


def turn_between(camera: Camera, before: Features, now: Features) -> Array | None:
    """Rotation vector (3,), rad, of the camera as it is in the camera as it was; None where too few agree.

    A shift counts as the turn that looks like it. Iterated least squares on rays with Cauchy's weights, as
    wide as the median of what is left: what matches wrongly, or moves by itself, soon weighs nothing.
    """
    a, b = match_corners(before, now)
    if len(a) < LEAST_CORNERS:
        return None
    first, second = (_directions(camera, pixels) for pixels in (before.pixels[a], now.pixels[b]))
    pixel = 1.0 / np.sqrt(camera.fx * camera.fy)
    turn, off = np.eye(3), np.linalg.norm(first - second, axis=1)
    for _ in range(ITERATIONS):
        turned = second @ turn.T
        weights = 1.0 / (1.0 + (off / max(float(np.median(off)), NARROWEST_PX * pixel)) ** 2)
        # A small step moves a ray by step x turned: the normal equations of that being what is left.
        normal = np.eye(3) * weights.sum() - np.einsum("i,ij,ik->jk", weights, turned, turned)
        step = np.linalg.lstsq(normal, weights @ np.cross(turned, first), rcond=SPREAD)[0]
        turn = so3_exp(step) @ turn
        off = np.linalg.norm(first - second @ turn.T, axis=1)
    agree = np.count_nonzero(off < AGREEING_PX * pixel) >= LEAST_CORNERS
    return so3_log(turn) if agree else None


def _directions(camera: Camera, pixels: Array) -> Array:
    ray = rays(camera, pixels)
    unit: Array = ray / np.linalg.norm(ray, axis=1)[:, None]
    return unit
