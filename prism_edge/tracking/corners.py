"""Which keypoints are corners, and not points of a straight edge.

FAST takes points of an edge for corners where its pixels are uneven. They slide along it from frame to frame,
all to the same side, so no robust kernel minds: of those at a tiled wall two in three are of that kind, and
turned the camera by a degree a frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array

SAMPLES, STEP = 5, 1.5  # of the gradient, a side; pixels between them
FLATTEST = 0.04  # Harris' k: one eigenvalue of the structure tensor is a twentieth of the other
_SMOOTH, _CHANGE = (1.0, 2.0, 1.0), (-1.0, 0.0, 1.0)  # Sobel's, across and along
_AT = np.rint(STEP * (np.arange(SAMPLES) - SAMPLES // 2)).astype(int)
REACH = int(_AT[-1]) + 1  # pixels that a patch has on each side of its keypoint
SIDE = 2 * REACH + 1


def are_corners(patches: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Whether images change both ways about their middles, by Harris' measure (1988).

    ``patches`` (n, SIDE, SIDE) are what the keypoints' own levels of the pyramid show about them.
    """
    # One product for all gradients: those of whole images take several times as long.
    gradients = patches.reshape(len(patches), SIDE * SIDE).astype(np.float32) @ _SOBEL
    gx, gy = gradients[:, : SAMPLES * SAMPLES], gradients[:, SAMPLES * SAMPLES :]
    xx, yy, xy = (np.einsum("ij,ij->i", a, b) for a, b in ((gx, gx), (gy, gy), (gx, gy)))
    corners: NDArray[np.bool_] = xx * yy - xy * xy > FLATTEST * (xx + yy) ** 2
    return corners


def _sobel() -> NDArray[np.float32]:
    """What a patch's pixels count in its gradients, along x and along y: (SIDE^2, 2 SAMPLES^2)."""
    smooth, change = _placed(_SMOOTH), _placed(_CHANGE)
    # (axis; row and column of a sample; row and column of a pixel)
    both = np.stack([np.einsum("ay,bx->abyx", *way) for way in ((smooth, change), (change, smooth))])
    return np.ascontiguousarray(both.reshape(-1, SIDE * SIDE).T.astype(np.float32))


def _placed(kernel: tuple[float, ...]) -> Array:
    """A kernel of three about each sample along a patch's side: (SAMPLES, SIDE)."""
    placed = np.zeros((SAMPLES, SIDE))
    placed[np.arange(SAMPLES)[:, None], REACH + _AT[:, None] + (-1, 0, 1)] = kernel
    return placed


_SOBEL = _sobel()
