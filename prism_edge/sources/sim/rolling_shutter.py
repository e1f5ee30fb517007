"""A picture whose rows are taken one after the other, from the one at the middle and its depth."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, inverse
from prism_edge.messages import F32, U8

_STEPS = 3  # of the search for what a pixel shows; the third moves it by less than a hundredth of a pixel
_ROWS = 16  # from one exact pose to the next


def rolled(
    picture: U8,
    depth: F32,
    camera: Camera,
    pose_at: Callable[[float], Array],
    seconds: float,
    readout_s: float,
) -> U8:
    """The picture (h, w, c) of a camera that reads its first row ``readout_s`` before its last.

    ``picture`` and ``depth`` (h, w), metres, are those at ``seconds``, when the row in the middle is read;
    ``pose_at`` gives world_from_camera at a time. People are taken to stand still meanwhile.
    """
    h, w = depth.shape
    marks = np.arange(0, h + _ROWS, _ROWS)
    at_middle = pose_at(seconds)
    when = seconds + ((marks + 0.5) / h - 0.5) * readout_s
    exact = np.array([inverse(pose_at(t)) @ at_middle for t in when])
    y, x = np.mgrid[0:h, 0:w].astype(np.float32)
    low, share = np.divmod(np.arange(h) / _ROWS, 1.0)
    first = low.astype(int)
    moved = exact[first] + (exact[first + 1] - exact[first]) * share[:, None, None]
    m = moved.astype(np.float32)[:, None]
    u, v = x.copy(), y.copy()
    for _ in range(_STEPS):
        z = cv2.remap(depth, u, v, cv2.INTER_NEAREST, None, cv2.BORDER_REPLICATE)
        p = (u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z
        a, b, c = (sum(m[..., i, k] * p[k] for k in range(3)) + m[..., i, 3] for i in range(3))
        u += x - (a / c * camera.fx + camera.cx)
        v += y - (b / c * camera.fy + camera.cy)
    return np.asarray(cv2.remap(picture, u, v, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE), np.uint8)
