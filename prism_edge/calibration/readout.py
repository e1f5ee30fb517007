"""How long a rolling shutter takes to read an image, from what it leaves in the residuals of tracked frames.

What a camera that moves reads late it sees from elsewhere: a residual that is the pixel's motion times its
row's share of the readout. The pose of each frame is solved for beside it, since that takes a part of it in.
"""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array

HUBER = 1.5  # sigmas
LEAST_POINTS = 30  # of a frame, for seven unknowns
BLOCKS = 10  # of frames in their order: errors of neighbours are alike
NEAREST = 1e-3  # depth of a point that is in front


class ReadoutFit:
    """Sums up frames; what they say is how much longer the readout is than was taken for it.

    Where that is much, too little of it: what is moved far weighs less, as outliers do.
    """

    def __init__(self) -> None:
        self._frames: list[tuple[float, float]] = []  # information (1/s^2), and it times the readout (1/s)

    def __len__(self) -> int:
        return len(self._frames)

    def add(
        self, camera: Camera, points: Array, pixels: Array, rows: Array, sigmas: Array, twist: Array
    ) -> None:
        """One frame: its n ``points`` (n, 3) in the camera's frame, and their ideal ``pixels`` (n, 2).

        ``rows`` (n,) are those of the image as taken, ``sigmas`` (n,) pixels; ``twist`` (6,) is the camera's
        motion a second, translation first, in its own frame and the points' unit.
        """
        front = points[:, 2] > NEAREST
        if np.count_nonzero(front) < LEAST_POINTS:
            return
        points, pixels, rows, sigmas = points[front], pixels[front], rows[front], sigmas[front]
        by_pose = _by_pose(camera, points)
        share = (rows + 0.5) / camera.height - 0.5
        by_readout = share[:, None] * (by_pose @ twist)
        seen = camera.to_pixels(points[:, :2] / points[:, 2:])
        residual = (pixels - seen) / sigmas[:, None]
        size = np.linalg.norm(residual, axis=1)
        weight = np.minimum(1.0, HUBER / np.maximum(size, 1e-12))
        columns = np.concatenate([by_pose, by_readout[:, :, None]], axis=2) / sigmas[:, None, None]
        weighted = weight[:, None, None] * columns
        normal = np.einsum("nij,nik->jk", weighted, columns)
        right = np.einsum("nij,ni->j", weighted, residual)
        taken = np.linalg.lstsq(normal[:6, :6], np.column_stack([normal[:6, 6], right[:6]]), rcond=1e-9)[0]
        self._frames.append((
            float(normal[6, 6] - normal[6, :6] @ taken[:, 0]), float(right[6] - normal[6, :6] @ taken[:, 1])
        ))

    @property
    def left_ms(self) -> tuple[float, float]:
        """What is missing of the readout and its sigma, ms; nan where the camera hardly moved.

        The sigma is a jackknife's over ten blocks of frames.
        """
        if len(self._frames) < BLOCKS:
            return np.nan, np.nan
        blocks = [np.sum(block, axis=0) for block in np.array_split(np.array(self._frames), BLOCKS)]
        whole = np.sum(blocks, axis=0)
        without = np.array([whole - block for block in blocks])
        if (without[:, 0] <= 0.0).any():
            return np.nan, np.nan
        partial = without[:, 1] / without[:, 0]
        sigma = np.sqrt((BLOCKS - 1) / BLOCKS * np.sum((partial - partial.mean()) ** 2))
        return 1e3 * float(whole[1] / whole[0]), 1e3 * float(sigma)


def _by_pose(camera: Camera, points: Array) -> Array:
    """d(pixel)/d(twist of the camera) (n, 2, 6): a point p goes to p - v - w x p in the camera's frame."""
    x, y, z = points.T
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
    by_point[:, 1, 1], by_point[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
    by_twist: Array = np.concatenate([-by_point, np.cross(by_point, points[:, None, :])], axis=2)
    return by_twist
