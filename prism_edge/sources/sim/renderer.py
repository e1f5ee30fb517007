"""Draws what a camera sees: a buffer of surface numbers first, then each surface's texture, warped once.

Every surface is flat, so its picture is a homography of its texture and its inverse depth is affine in
the pixel: both are exact. Numbers are painted far to near, finer than the picture, whereafter only what
really shows of a surface is warped, and added with the share of each pixel that it covers. Textures are
taken from copies shrunk along each axis to about the pixel's own size.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array
from prism_edge.messages import F32, U8
from prism_edge.sources.sim.surfaces import MARGIN, Surfaces, with_margin
from prism_edge.sources.sim.visibility import Visible, see
from prism_edge.sources.sim.world import World

_MOST_OCTAVES = 5  # octaves a texture is shrunk by at most
_MOST_KEPT = 128 << 20  # bytes of shrunk textures: a town has more than fit, and shows few of them at a time
_SHIFT = 4  # binary places of polygon corners
_WARP = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
_OVERSAMPLING = 2  # of the numbers, to smooth edges
# For depth they are finer by an odd number, so that a sample lies at the centre of each pixel.
_DEPTH_OVERSAMPLING = 5


class Picture(NamedTuple):
    """A clean picture (h, w, 4), BGR and an unused channel, and the depth (m) of most of what it shows."""

    pixels: U8
    depth: float


class Renderer:
    """Pictures and depth of one world through one ideal pinhole camera."""

    def __init__(self, world: World, camera: Camera) -> None:
        self.world = world
        self.camera = camera
        self._numbers = np.zeros(
            (camera.height * _OVERSAMPLING, camera.width * _OVERSAMPLING), dtype=np.uint16
        )
        # Room for intermediate pictures of any part of the picture, so that none is allocated anew.
        area = camera.height * camera.width
        self._fine = np.zeros(area * _OVERSAMPLING**2, dtype=np.uint8)
        self._covered = np.zeros(area, dtype=np.uint8)
        self._warped = np.zeros(area * 4, dtype=np.uint8)
        self._weights = np.zeros(area * 4, dtype=np.uint8)
        self._sizes = np.array([t.shape[1::-1] for t in world.textures], dtype=np.float64) - 2 * MARGIN
        self._shrunk: dict[tuple[int, tuple[int, int]], U8] = {}  # last used last
        self._kept = 0  # bytes of them

    def draw(self, world_from_camera: Array, walkers: Mapping[int, Surfaces]) -> Picture:
        """The picture from a pose, without any of a lens's or sensor's faults."""
        visible = see(self.world, walkers, self.camera, world_from_camera)
        _paint_numbers(visible, self._numbers, _OVERSAMPLING)
        sizes, to_textures = _shrinking(visible, self._sizes[visible.texture])
        picture = np.zeros((self.camera.height, self.camera.width, 4), dtype=np.uint8)
        textures = visible.texture.tolist()
        n = _OVERSAMPLING
        for number, (left, top, right, bottom) in enumerate(_bounds(visible)):
            if left >= right or top >= bottom:
                continue
            w, h = right - left, bottom - top
            fine = self._fine[: w * h * n * n].reshape(h * n, w * n)
            cv2.inRange(
                self._numbers[top * n : bottom * n, left * n : right * n], number + 1, number + 1, fine
            )
            covered = cv2.resize(fine, (w, h), self._covered[: w * h].reshape(h, w), 0, 0, cv2.INTER_AREA)
            x, y, w, h = cv2.boundingRect(covered)
            if not w:
                continue
            texture = self._texture(textures[number], sizes[number])
            to_texture = to_textures[number]
            to_texture[:, 2] += to_texture[:, 0] * (left + x) + to_texture[:, 1] * (top + y)
            warped, weights = (room[: 4 * w * h].reshape(h, w, 4) for room in (self._warped, self._weights))
            cv2.warpPerspective(texture, to_texture, (w, h), warped, _WARP)
            cv2.cvtColor(covered[y : y + h, x : x + w], cv2.COLOR_GRAY2BGRA, weights)
            cv2.multiply(warped, weights, warped, 1.0 / 255.0)
            target = picture[top + y : top + y + h, left + x : left + x + w]
            cv2.add(target, warped, target)
        return Picture(picture, self._usual_depth(visible))

    def _usual_depth(self, visible: Visible) -> float:
        """The median depth of a coarse grid of pixels."""
        y = np.arange(self.camera.height // 16, self.camera.height, max(1, self.camera.height // 8))[:, None]
        x = np.arange(self.camera.width // 16, self.camera.width, max(1, self.camera.width // 8))
        rows = self._numbers[y * _OVERSAMPLING, x * _OVERSAMPLING].astype(np.int64) - 1
        plane = visible.image_to_plane[:, 2]
        inverse_depth = plane[rows, 0] * x + plane[rows, 1] * y + plane[rows, 2]
        return 1.0 / max(float(np.median(inverse_depth)), 1e-3)

    def depth(self, world_from_camera: Array, walkers: Mapping[int, Surfaces]) -> F32:
        """Distance along the optical axis (h, w), metres, exact at each pixel's centre."""
        n, camera = _DEPTH_OVERSAMPLING, self.camera
        visible = see(self.world, walkers, camera, world_from_camera)
        numbers = np.zeros((camera.height * n, camera.width * n), dtype=np.uint16)
        _paint_numbers(visible, numbers, n)
        rows = numbers[n // 2 :: n, n // 2 :: n].astype(np.int64) - 1
        plane = visible.image_to_plane[:, 2]
        x, y = np.arange(camera.width), np.arange(camera.height)[:, None]
        inverse_depth = plane[rows, 0] * x + plane[rows, 1] * y + plane[rows, 2]
        return np.where(rows >= 0, 1.0 / np.maximum(inverse_depth, 1e-6), 0.0).astype(np.float32)

    def _texture(self, number: int, size: tuple[int, int]) -> U8:
        """A texture shrunk to ``size`` (width, height, without its margin)."""
        base = self.world.textures[number]
        if size == (base.shape[1] - 2 * MARGIN, base.shape[0] - 2 * MARGIN):
            return base
        found = self._shrunk.pop((number, size), None)
        if found is None:
            inside = base[MARGIN:-MARGIN, MARGIN:-MARGIN]
            found = with_margin(cv2.resize(inside, size, interpolation=cv2.INTER_AREA))
            self._kept += found.nbytes
            while self._kept > _MOST_KEPT and self._shrunk:
                self._kept -= self._shrunk.pop(next(iter(self._shrunk))).nbytes
        self._shrunk[number, size] = found
        return found


def _paint_numbers(visible: Visible, numbers: NDArray[np.uint16], oversampling: int) -> None:
    """Writes into each fine pixel the number, from 1, of the surface that shows there; 0: there is none."""
    numbers[:] = 0
    rects = visible.rects * oversampling
    fine = (visible.polygons + 0.5) * oversampling - 0.5 - rects[:, None, :2]
    fixed = np.rint(fine * (1 << _SHIFT)).astype(np.int32)
    for row, (left, top, right, bottom) in enumerate(rects.tolist()):
        cv2.fillConvexPoly(numbers[top:bottom, left:right], fixed[row], row + 1, cv2.LINE_8, _SHIFT)


def _bounds(visible: Visible) -> list[list[int]]:
    """Rectangles (left, top, right, bottom) that hold all that is drawn of each surface."""
    low = np.floor(visible.polygons.min(axis=1)).astype(np.int64) - 1
    high = np.ceil(visible.polygons.max(axis=1)).astype(np.int64) + 2
    rects = visible.rects
    bounds = np.concatenate([np.maximum(low, rects[:, :2]), np.minimum(high, rects[:, 2:])], axis=1)
    out: list[list[int]] = bounds.tolist()
    return out


def _shrinking(visible: Visible, sizes: Array) -> tuple[list[tuple[int, int]], Array]:
    """The size to shrink each texture to, and the homographies (n, 3, 3) from the picture into it.

    ``sizes`` (n, 2) are the textures' widths and heights. What counts is how many of their pixels one
    pixel of the picture spans in the middle of the part that may show. Sizes go by roots of two.
    """
    inside = np.clip(visible.polygons, visible.rects[:, None, :2], visible.rects[:, None, 2:])
    planes = visible.image_to_plane
    places = np.einsum("nij,nj->ni", planes[:, :, :2], inside.mean(axis=1)) + planes[:, :, 2]
    inverse_depth = places[:, 2:]
    ratio = places[:, :2] / inverse_depth
    slopes = planes[:, :2, :2] - ratio[:, :, None] * planes[:, 2:, :2]
    texels = np.sqrt(np.square(slopes).sum(axis=2)) / np.abs(inverse_depth) * sizes
    steps = np.floor(2.0 * np.log2(np.clip(texels, 1.0, 2.0**_MOST_OCTAVES)) + 0.5)
    shrunk = np.maximum(1.0, np.rint(sizes * 2.0 ** (-0.5 * steps)))
    to_textures = planes.copy()
    to_textures[:, :2] = planes[:, :2] * shrunk[:, :, None] + (MARGIN - 0.5) * planes[:, 2:]
    return [(x, y) for x, y in shrunk.astype(int).tolist()], to_textures
