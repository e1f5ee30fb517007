"""Which ideal pixels a camera's image shows: its border, straight as taken, is bent in ideal pixels."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array

FARTHEST = 2.0  # image sizes from where it was taken: a fisheye's rim has no ideal pixel
_ALONG = 64  # points of each side


def has_ideal_pixel(camera: Camera, raw: Array, ideal: Array) -> NDArray[np.bool_]:
    """Which pixels as taken (n, 2) have one, ``ideal`` (n, 2), that is of use."""
    near: NDArray[np.bool_] = np.abs(ideal - raw).max(axis=1, initial=0.0) < FARTHEST * max(
        camera.width, camera.height
    )
    return near


def in_image(camera: Camera, ideal: Array) -> NDArray[np.bool_]:
    """Which ideal (undistorted) pixels (n, 2) lie in the image as it was taken."""
    outer, inner = _bounds(camera)
    x, y = ideal[:, 0], ideal[:, 1]
    inside = (x >= outer[0]) & (x < outer[1]) & (y >= outer[2]) & (y < outer[3])
    if camera.is_ideal:
        return inside
    # Only between the boxes has the bent border to be asked.
    doubtful = inside & ~((x >= inner[0]) & (x < inner[1]) & (y >= inner[2]) & (y < inner[3]))
    at = np.flatnonzero(doubtful)
    if len(at):
        raw = camera.distort_pixels(ideal[at])
        there = np.all((raw >= 0) & (raw < (camera.width, camera.height)), axis=1)
        inside[at] = there & has_ideal_pixel(camera, raw, ideal[at])
    return inside


@lru_cache(maxsize=64)
def _bounds(camera: Camera) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Left, right, top and bottom of the boxes about the image and within it, in ideal pixels."""
    width, height = float(camera.width), float(camera.height)
    if camera.is_ideal:
        whole = (0.0, width, 0.0, height)
        return whole, whole
    longer = max(width, height)
    low, high = -FARTHEST * longer, (1.0 + FARTHEST) * longer
    x, y = np.linspace(0.0, width, _ALONG), np.linspace(0.0, height, _ALONG)
    none = np.zeros(_ALONG)
    sides = ((none, y), (none + width, y), (x, none), (x, none + height))
    left, right, top, bottom = (
        np.clip(camera.undistort_pixels(np.stack(side, axis=1)), low, high) for side in sides
    )
    border = np.concatenate([left, right, top, bottom])
    outer = (*(border[:, 0].min(), border[:, 0].max()), *(border[:, 1].min(), border[:, 1].max()))
    inner = (left[:, 0].max(), right[:, 0].min(), top[:, 1].max(), bottom[:, 1].min())
    return tuple(map(float, outer)), tuple(map(float, inner))
