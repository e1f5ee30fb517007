"""Depth maps laid together as one cloud: a point a voxel, the mean of what fell into it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array, transform
from prism_edge.reconstruction.look import surface
from prism_edge.scale.gate import DepthView

_SUMS = 10  # weight, position, normal, colour
_MOST_STEPS = 1 << 20  # voxels along an axis, either way: three of them fit into 64 bits
_FLUSH = 2_000_000  # points that are waited with until they are laid together
_BENT = 1.25  # a surface's depth changes by less from a pixel to the next: else it is an edge
_STEEPEST = 0.15  # cosine between normal and ray: what is seen under less than 9 degrees is mostly an outline


@dataclass(frozen=True)
class Cloud:
    """Points (n, 3) in metres, unit normals (n, 3) towards who saw them, and colours (n, 3) RGB."""

    points: Array
    normals: Array
    colours: NDArray[np.uint8]


@dataclass
class Voxels:
    """Sums over what fell into each voxel of a grid; nearer views, which know better, weigh more."""

    size: float  # m
    _keys: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    _sums: list[Array] = field(default_factory=lambda: [np.zeros(0) for _ in range(_SUMS)])
    _waiting: list[tuple[NDArray[np.int64], Array]] = field(default_factory=list)
    _count: int = 0

    def add(self, points: Array, normals: Array, colours: NDArray[np.uint8], weights: Array) -> int:
        """Points, normals, colours (n, 3) and weights (n,) above 0; how many lie on the grid, and are in."""
        steps = np.floor(points / self.size)
        inside = np.all(np.abs(steps) < _MOST_STEPS, axis=1)
        steps = steps[inside].astype(np.int64) + _MOST_STEPS
        keys = (steps[:, 0] << 42) | (steps[:, 1] << 21) | steps[:, 2]
        w = weights[inside, None]
        rows = np.hstack([w, w * points[inside], w * normals[inside], w * colours[inside]])
        self._waiting.append((keys, rows))
        self._count += len(keys)
        if self._count >= _FLUSH:
            self._lay_together()
        return len(keys)

    def cloud(self) -> Cloud:
        """One point a voxel, by the order of the voxels."""
        self._lay_together()
        weight, sums = self._sums[0], self._sums
        points = np.column_stack([one / weight for one in sums[1:4]])
        normals = np.column_stack([one / weight for one in sums[4:7]])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals /= np.where(length > 0, length, 1.0)
        colours = [np.clip(np.rint(one / weight), 0, 255).astype(np.uint8) for one in sums[7:]]
        return Cloud(points, normals, np.column_stack(colours))

    def _lay_together(self) -> None:
        """Column by column, and what is new between what is sorted: a street has ten million voxels."""
        if not self._waiting:
            return
        keys, where = np.unique(np.concatenate([k for k, _ in self._waiting]), return_inverse=True)
        at = np.searchsorted(self._keys, keys)
        known = np.append(self._keys, -1)[at] == keys
        before = at[~known]
        for i, column in enumerate(self._sums):
            added = np.bincount(where, np.concatenate([rows[:, i] for _, rows in self._waiting]), len(keys))
            column[at[known]] += added[known]
            self._sums[i] = np.insert(column, before, added[~known])
        self._keys = np.insert(self._keys, before, keys[~known])
        self._waiting, self._count = [], 0


def lay(
    voxels: Voxels, view: DepthView, kept: NDArray[np.bool_], colours: NDArray[np.uint8]
) -> tuple[int, int]:
    """Add a view's pixels (h, w) that are ``kept``; ``colours`` (h, w, 3) are theirs.

    How many came in, and how many lie beyond the grid; outlines and the picture's rim are neither.
    """
    local = surface(view)
    normals, smooth = _normals(local)
    facing = -np.sum(normals * local, axis=2) > _STEEPEST * np.linalg.norm(local, axis=2)
    chosen = kept & smooth & facing
    points = transform(view.world_from_camera, local[chosen])
    turned = normals[chosen] @ view.world_from_camera[:3, :3].T
    laid = voxels.add(points, turned, colours[chosen], 1.0 / local[chosen][:, 2] ** 2)
    return laid, len(points) - laid


def _normals(local: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Unit normals (h, w, 3) towards the camera of points (h, w, 3), and where (h, w) there is a surface."""
    across, down = np.zeros_like(local), np.zeros_like(local)
    across[:, 1:-1], down[1:-1] = local[:, 2:] - local[:, :-2], local[2:] - local[:-2]
    normals = np.cross(down, across)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    z = local[..., 2]
    smooth = np.zeros(z.shape, bool)
    around = np.stack([z[1:-1, 1:-1], z[1:-1, :-2], z[1:-1, 2:], z[:-2, 1:-1], z[2:, 1:-1]])
    low, high = around.min(axis=0), around.max(axis=0)
    smooth[1:-1, 1:-1] = (low > 0) & (high < _BENT * low)
    return normals / np.where(length > 0, length, 1.0), smooth & (length[..., 0] > 0)
