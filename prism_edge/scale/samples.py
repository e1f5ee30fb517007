"""Log ratios between the network's depth and the map's, at the keypoints of one keyframe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array
from prism_edge.messages import Depth, Keyframe

Floats = NDArray[np.floating[Any]]

# Nearest to farthest within 3 x 3 pixels of the network's map: beyond this a keypoint sits on an edge of
# depth, where the network blurs (on real video the spread of the ratios doubles there).
EDGE_RATIO = 1.15
# Errors of a depth network reach over about an eighth of the image's width (docs/SCALE.md).
PATCHES_ACROSS = 8


@dataclass(frozen=True)
class Samples:
    """What the keypoints of one keyframe say about log scale.

    ``log_ratios`` (n,) is log(network metres) - log(map units) along z; ``patches`` (n,) numbers the square
    of the image that each lies in; ``keypoints`` (n,) are their rows in the keyframe.
    """

    log_ratios: Array
    patches: NDArray[np.int64]
    keypoints: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.log_ratios)


def depth_at(
    depth: Floats, positions: Array, edge_ratio: float = EDGE_RATIO
) -> tuple[Array, NDArray[np.bool_]]:
    """Bilinear depth (n,) at positions (n, 2) = (x, y) of a depth map (h, w), and which of them count.

    One doesn't count when it lies outside, when a pixel among the 3 x 3 round it is invalid (zero, negative,
    not finite), or when the farthest of them is beyond ``edge_ratio`` times the nearest.
    """
    height, width = depth.shape
    values = np.zeros(len(positions))
    inside = np.isfinite(positions).all(axis=1)
    inside &= ((positions >= -0.5) & (positions <= np.array([width, height]) - 0.5)).all(axis=1)
    counts = np.zeros(len(positions), dtype=bool)
    if not inside.any() or min(height, width) < 3:
        return values, counts
    # beyond the outermost pixel centres there is nothing to interpolate between
    x = np.clip(positions[inside, 0], 0.0, width - 1.0)
    y = np.clip(positions[inside, 1], 0.0, height - 1.0)
    column = np.clip(np.rint(x).astype(np.int64), 1, width - 2)
    row = np.clip(np.rint(y).astype(np.int64), 1, height - 2)
    steps = np.arange(-1, 2)
    window = depth[row[:, None, None] + steps[:, None], column[:, None, None] + steps].reshape(-1, 9)
    window = window.astype(np.float64)
    sound = (np.isfinite(window) & (window > 0.0)).all(axis=1)
    window[~sound] = 1.0
    sound &= window.max(axis=1) <= edge_ratio * window.min(axis=1)

    left = np.clip(np.floor(x).astype(np.int64), 0, width - 2)
    top = np.clip(np.floor(y).astype(np.int64), 0, height - 2)
    dx, dy = x - left, y - top
    corners = np.stack([depth[top + i, left + j] for i in (0, 1) for j in (0, 1)], axis=1).astype(np.float64)
    corners[~sound] = 1.0
    weights = np.stack([(1 - dy) * (1 - dx), (1 - dy) * dx, dy * (1 - dx), dy * dx], axis=1)
    values[inside] = np.where(sound, (corners * weights).sum(axis=1), 0.0)
    counts[inside] = sound
    return values, counts


def samples_of(keyframe: Keyframe, depth: Depth, camera: Camera, min_parallax_deg: float) -> Samples:
    """:func:`sample` of a keyframe of this camera and the network's answer to it, as they were sent."""
    return sample(
        camera,
        keyframe.pixels,
        keyframe.depths,
        keyframe.parallax_deg,
        depth.depth,
        depth.image_to_depth,
        min_parallax_deg,
    )


def sample(
    camera: Camera,
    pixels: Floats,
    map_depths: Floats,
    parallax_deg: Floats,
    depth: Floats,
    image_to_depth: Array,
    min_parallax_deg: float,
) -> Samples:
    """Samples at the keypoints whose map point was triangulated at ``min_parallax_deg`` or more.

    ``pixels`` (n, 2) undistorted, ``map_depths`` (n,) along z in map units (0: no point), ``parallax_deg``
    (n,) the largest angle of the point's triangulation; a point seeded from network depth has 0 and is never
    used, as it would only tell the network what the network has said (design: WLS on triangulated points).
    ``depth`` (h, w) in metres, invalid 0; ``image_to_depth`` (4,) maps raw pixels to it (messages.Depth).
    """
    usable = np.isfinite(map_depths) & (map_depths > 0.0) & (parallax_deg >= min_parallax_deg)
    rows = np.flatnonzero(usable & (parallax_deg > 0.0))
    raw = camera.distort_pixels(np.asarray(pixels, dtype=np.float64)[rows])
    values, counts = depth_at(depth, raw * image_to_depth[[0, 2]] + image_to_depth[[1, 3]])
    rows, raw, values = rows[counts], raw[counts], values[counts]
    size = camera.width / PATCHES_ACROSS
    column, row = np.floor((raw + 0.5) / size).astype(np.int64).T
    log_ratios = np.log(values) - np.log(np.asarray(map_depths, dtype=np.float64)[rows])
    return Samples(log_ratios, row * (PATCHES_ACROSS + 1) + column, rows)
