"""Luma and exact depth of textured rectangles, seen by a pinhole camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import inverse, transform
from tests.synthetic.scene import TEXELS_PER_M, Face

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_NEAR = 0.05  # m
_SEAM = 1e-4  # m by which faces overlap, so that rounding leaves no gap between neighbours
_LEVELS = 4  # mip-map


@dataclass(frozen=True)
class Atlas:
    """The textures of all faces stacked in one image, at full, half, quarter ... resolution."""

    levels: tuple[NDArray[np.uint8], ...]
    rows: tuple[int, ...]  # where each face's texture begins, texels of level 0


class Renderer:
    """Draws what a camera sees of a list of faces."""

    def __init__(self, faces: Sequence[Face], camera: Camera) -> None:
        self._faces, self._camera = faces, camera
        self._atlas = _atlas(faces)
        x, y = np.arange(camera.width), np.arange(camera.height)
        self._x = ((x - camera.cx) / camera.fx).astype(np.float32)
        self._y = ((y - camera.cy) / camera.fy).astype(np.float32)
        self._ray_length = np.sqrt(1.0 + self._x[None, :] ** 2 + self._y[:, None] ** 2)

    def draw(self, world_from_camera: F64) -> tuple[NDArray[np.uint8], F32]:
        """Luma (h, w) uint8 and depth along z (h, w) float32 in metres; 0 where no face is."""
        shape = (self._camera.height, self._camera.width)
        nearest = np.zeros(shape, np.float32)  # inverse depth
        u, v, footprint = (np.zeros(shape, np.float32) for _ in range(3))
        camera_from_world = inverse(world_from_camera)
        for face, row in zip(self._faces, self._atlas.rows, strict=True):
            if face.normal @ (world_from_camera[:3, 3] - face.corner) > 0:
                self._add(face, row, camera_from_world, nearest, u, v, footprint)
        depth = np.where(nearest > 0, 1.0 / np.maximum(nearest, 1e-9), 0.0).astype(np.float32)
        return self._shade(u, v, footprint), depth

    def _add(self, face: Face, row: int, pose: F64, nearest: F32, u: F32, v: F32, footprint: F32) -> None:
        """Draws one face wherever it is nearer than what is there."""
        polygon = _clipped(transform(pose, face.corners()))
        if len(polygon) < 3:
            return
        c = self._camera
        pixels = polygon[:, :2] / polygon[:, 2:] * (c.fx, c.fy) + (c.cx, c.cy)
        low = np.clip(np.floor(pixels.min(axis=0)) - 1, 0, (c.width, c.height)).astype(int)
        high = np.clip(np.ceil(pixels.max(axis=0)) + 2, 0, (c.width, c.height)).astype(int)
        if np.any(high <= low):
            return
        area = (slice(low[1], high[1]), slice(low[0], high[0]))
        rotation = pose[:3, :3]
        normal, corner = rotation @ face.normal, transform(pose, face.corner[None])[0]
        x, y = self._x[area[1]], self._y[area[0]][:, None]
        # On a plane, inverse depth is linear in the pixel: n . (z ray) = n . corner.
        a = (normal / (normal @ corner)).astype(np.float32)
        inverse_depth = a[0] * x + a[1] * y + a[2]
        seen = inverse_depth > nearest[area]
        depth = 1.0 / np.where(seen, inverse_depth, 1.0)
        along = []
        for axis, extent in ((face.right, face.width), (face.down, face.height)):
            e = (rotation @ axis).astype(np.float32)
            metres = (e[0] * x + e[1] * y + e[2]) * depth - np.float32(e @ corner)
            seen &= (metres > -_SEAM) & (metres < extent + _SEAM)
            along.append(metres)
        for metres, out, extent, start in zip(along, (u, v), face.texture.shape[::-1], (0, row), strict=True):
            texel = np.clip(metres * TEXELS_PER_M - 0.5, 0.0, extent - 1.0) + start
            np.copyto(out[area], texel.astype(np.float32), where=seen)
        # texels a pixel along the direction in which the face is foreshortened
        cosine = np.abs(inverse_depth * np.float32(normal @ corner)) / self._ray_length[area]
        texels = depth * np.float32(TEXELS_PER_M / c.fx) / np.sqrt(np.maximum(cosine, 0.05))
        np.copyto(footprint[area], texels.astype(np.float32), where=seen)
        np.copyto(nearest[area], inverse_depth.astype(np.float32), where=seen)

    def _shade(self, u: F32, v: F32, footprint: F32) -> NDArray[np.uint8]:
        """Texture looked up with linear blending within and between levels of resolution."""
        level = np.clip(np.log2(np.maximum(footprint, 1.0)), 0.0, _LEVELS - 1.0)
        luma = np.zeros(u.shape, np.float32)
        for i, texture in enumerate(self._atlas.levels):
            weight = np.maximum(0.0, 1.0 - np.abs(level - i))
            if not weight.any():
                continue
            shrink = np.float32(0.5**i)
            x, y = (u + 0.5) * shrink - 0.5, (v + 0.5) * shrink - 0.5
            luma += weight * cv2.remap(texture, x, y, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        return np.round(luma).astype(np.uint8)


def _atlas(faces: Sequence[Face]) -> Atlas:
    step = 2 ** (_LEVELS - 1)  # textures begin at whole texels of every level
    width = max(-(-face.texture.shape[1] // step) * step for face in faces)
    blocks, rows, top = [], [], 0
    for face in faces:
        height, own_width = face.texture.shape
        below = -(-height // step) * step - height + step
        blocks.append(cv2.copyMakeBorder(face.texture, 0, below, 0, width - own_width, cv2.BORDER_REPLICATE))
        rows.append(top)
        top += height + below
    level = np.concatenate(blocks)
    levels = [level]
    for _ in range(_LEVELS - 1):
        level = cv2.resize(level, (level.shape[1] // 2, level.shape[0] // 2), interpolation=cv2.INTER_AREA)
        levels.append(level)
    return Atlas(tuple(levels), tuple(rows))


def _clipped(corners: F64) -> F64:
    """The part of a polygon (n, 3) in front of the near plane (Sutherland-Hodgman)."""
    out = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if a[2] >= _NEAR:
            out.append(a)
        if (a[2] >= _NEAR) != (b[2] >= _NEAR):
            out.append(a + (b - a) * (_NEAR - a[2]) / (b[2] - a[2]))
    return np.array(out).reshape(-1, 3)
