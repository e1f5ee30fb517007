"""Which ideal pixels a camera's image shows: its border, straight as taken, is bent in ideal pixels.

Beyond the views it was fitted to, a lens model may fold over: pixels near the border then belong to no ray,
and rays from far outside end in the image. Of such a camera every ray and every pixel is sent there and back.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import FISHEYE, Camera
from prism_edge.geometry.fisheye import WIDEST, folds_at
from prism_edge.geometry.poses import Array

FARTHEST = 2.0  # image sizes from where it was taken: a fisheye's rim has no ideal pixel
_ALONG = 64  # points of each side
_THERE_AND_BACK = 1.0  # pixels


def has_ideal_pixel(camera: Camera, raw: Array, ideal: Array) -> NDArray[np.bool_]:
    """Which pixels as taken (n, 2) have one, ``ideal`` (n, 2), that is of use."""
    useful = _near(camera, raw, ideal)
    if _bounds(camera)[2]:
        useful[useful] = _returns(camera.distort_pixels(ideal[useful]), raw[useful])
    return useful


def folded(camera: Camera) -> float:
    """Share of the image that no ray comes to, through a lens that folds over."""
    if not _may_fold(camera):
        return 0.0
    v, u = np.mgrid[0 : camera.height - 1 : 75j, 0 : camera.width - 1 : 100j]
    pixels = np.column_stack([u.ravel(), v.ravel()])
    with np.errstate(all="ignore"):  # a lens that means nothing goes anywhere
        missed = np.linalg.norm(camera.distort_pixels(camera.undistort_pixels(pixels)) - pixels, axis=1)
    return float(1.0 - (missed <= _THERE_AND_BACK).mean())


def in_image(camera: Camera, ideal: Array) -> NDArray[np.bool_]:
    """Which ideal (undistorted) pixels (n, 2) lie in the image as it was taken."""
    outer, inner, folds = _bounds(camera)
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
        there &= _near(camera, raw, ideal[at])
        if folds:
            there[there] = _returns(camera.undistort_pixels(raw[there]), ideal[at][there])
        inside[at] = there
    return inside


def inner_box(camera: Camera) -> tuple[float, ...]:
    """Left, right, top and bottom, in ideal pixels, of an upright box all of which the image shows.

    Empty where the lens model folds over within the image.
    """
    return _bounds(camera)[1]


def _may_fold(camera: Camera) -> bool:
    """A sound fisheye has pixels that come back elsewhere too: those of rays from beside or behind it."""
    if camera.model == FISHEYE:
        return folds_at(camera.distortion) < WIDEST
    return not camera.is_ideal


def _near(camera: Camera, raw: Array, ideal: Array) -> NDArray[np.bool_]:
    near: NDArray[np.bool_] = np.abs(ideal - raw).max(axis=1, initial=0.0) < FARTHEST * max(
        camera.width, camera.height
    )
    return near


def _returns(came: Array, went: Array) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        back: NDArray[np.bool_] = np.abs(came - went).max(axis=1, initial=0.0) < _THERE_AND_BACK
    return back


@lru_cache(maxsize=64)
def _bounds(camera: Camera) -> tuple[tuple[float, ...], tuple[float, ...], bool]:
    """Left, right, top and bottom of the boxes about the image and within it, in ideal pixels.

    And whether the lens model folds over within the image: then neither box says anything.
    """
    width, height = float(camera.width), float(camera.height)
    if camera.is_ideal:
        whole = (0.0, width, 0.0, height)
        return whole, whole, False
    longer = max(width, height)
    low, high = -FARTHEST * longer, (1.0 + FARTHEST) * longer
    x, y = np.linspace(0.0, width, _ALONG), np.linspace(0.0, height, _ALONG)
    none = np.zeros(_ALONG)
    sides = ((none, y), (none + width, y), (x, none), (x, none + height))
    raw = [np.stack(side, axis=1) for side in sides]
    bent = [camera.undistort_pixels(side) for side in raw]
    returned = [_returns(camera.distort_pixels(b), side) for b, side in zip(bent, raw, strict=True)]
    if _may_fold(camera) and not np.all(returned):
        return (low, high, low, high), (0.0, 0.0, 0.0, 0.0), True
    left, right, top, bottom = (np.clip(side, low, high) for side in bent)
    border = np.concatenate([left, right, top, bottom])
    outer = (*(border[:, 0].min(), border[:, 0].max()), *(border[:, 1].min(), border[:, 1].max()))
    inner = (left[:, 0].max(), right[:, 0].min(), top[:, 1].max(), bottom[:, 1].min())
    return tuple(map(float, outer)), tuple(map(float, inner)), False
