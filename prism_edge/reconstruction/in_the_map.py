"""A network's depth of one keyframe in the map's metres: held to the points that the map has there.

A network's own metres, or its unit where it has none, waver from image to image and within one; a finished
map's triangulated points don't. Depth is bent to them as seeds are (tracking/depth_alignment.py), inverse
depth, which is known up to a shift as well, by a line first (depth/pairing.py).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.depth.pairing import fit_depth, fit_inverse_depth, metres
from prism_edge.geometry.poses import Array
from prism_edge.messages import F32
from prism_edge.reconstruction.viewpoints import Viewpoint
from prism_edge.scale.gate import nearest
from prism_edge.tracking.depth_alignment import MIN_ALIGNED, DepthAlignment
from prism_edge.tracking.seeding import sample_depth

_STEP = 4  # pixels at most between those that the ratio is worked out at
_OF_REACH = 0.4  # between them at most: the ratio bends over one reach of a point
FARTHEST = 3.0  # times the farthest point: inverse depth blows up beyond
_AT_ONCE = 512  # places: times as many points, they fit a cache


def from_relative(
    said: F32, image_to_depth: Array, viewpoint: Viewpoint, is_inverse: bool
) -> F32 | None:
    """Depth (h, w) in metres of depth, or inverse depth, (h, w) known up to scale and shift; 0 for none.

    None where the points say too little, or contradict it.
    """
    row, column, there = nearest(said.shape, image_to_depth, viewpoint.pixels)
    if not there.any():
        return None
    told, depths = said[row[there], column[there]].astype(np.float64), viewpoint.depths[there]
    fit = fit_inverse_depth(told, depths) if is_inverse else fit_depth(told, depths)
    if fit is None:
        return None
    values = said
    if not is_inverse:  # exactly 0 and infinity are no depth, and below 0 it has no inverse
        usable = np.isfinite(said) & (said != 0 if fit.of_depth else said > 0)
        known = np.where(usable, said, np.float32(np.nan))
        values = np.asarray(known if fit.of_depth else 1.0 / known, np.float32)
    return metres(values, fit, FARTHEST * float(viewpoint.depths.max()))


def aligned(
    depth: F32, image_to_depth: Array, viewpoint: Viewpoint, as_a_whole: bool = False
) -> F32 | None:
    """Depth (h, w), 0 for none, in whatever unit, as metres that agree with the points round each pixel.

    None where there are too few of those. Whether it tells near from far is not asked, as it is of seeds:
    what pictures and other keyframes don't bear out is left out anyway (docs/RECONSTRUCTION.md).
    ``as_a_whole``: by one ratio, for depth that was measured and has no more to learn from points.
    """
    good, told = sample_depth(depth, image_to_depth, viewpoint.pixels)
    if good.sum() < MIN_ALIGNED:
        return None
    camera = viewpoint.camera
    size = (camera.width, camera.height)
    fit = DepthAlignment.of(viewpoint.pixels[good], viewpoint.depths[good], told[good], size)
    if as_a_whole:
        return np.asarray(depth * np.float32(fit.overall.units_per_metre), np.float32)
    height, width = depth.shape
    a, b, c, d = image_to_depth
    step = max(1, min(_STEP, int(_OF_REACH * fit.reach * min(abs(a), abs(c)))))
    rows, columns = _steps(height, step), _steps(width, step)
    x, y = np.meshgrid((columns - b) / a, (rows - d) / c)
    places = np.column_stack([x.ravel(), y.ravel()])
    some = range(0, len(places), _AT_ONCE)
    coarse = np.concatenate([fit.at(places[i : i + _AT_ONCE])[0] for i in some]).reshape(x.shape)
    at_x, at_y = np.meshgrid(np.arange(width) / step, np.arange(height) / step)
    ratio = cv2.remap(
        coarse.astype(np.float32),
        at_x.astype(np.float32),
        at_y.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(depth * ratio, np.float32)


def shown_in(
    shown: NDArray[np.bool_], shape: tuple[int, ...], image_to_depth: Array
) -> NDArray[np.bool_]:
    """Which pixels of a depth map (h, w) show the world, by a mask of the whole image."""
    a, b, c, d = image_to_depth
    x, y = np.meshgrid((np.arange(shape[1]) - b) / a, (np.arange(shape[0]) - d) / c)
    at = cv2.remap(shown.astype(np.uint8), x.astype(np.float32), y.astype(np.float32), cv2.INTER_NEAREST)
    return np.asarray(at > 0)


def _steps(extent: int, step: int) -> Array:
    """Each ``step``-th pixel, one beyond the last so that all lie between two."""
    return np.arange(0, extent + step, step, dtype=np.float64)
