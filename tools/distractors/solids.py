"""Textured boxes and ellipsoids on paths through the world, and how a camera sees them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import inverse, se3_exp

Array = NDArray[np.float64]
BOX, ELLIPSOID = "box", "ellipsoid"
LIGHT = np.array([0.3, -0.8, -0.52])
NEAREST = 0.05  # metres before a camera


@dataclass(frozen=True)
class Distractor:
    """A solid on its own path: ``start`` to ``end`` seconds, at ``points`` (n, 3) at even times between."""

    shape: str
    half_extents: Array  # (3,) metres
    texture: int  # seed of what is painted on it
    start: float
    end: float
    points: Array
    yaw_rate: float  # radians a second about the world's vertical
    up: Array  # (3,) that vertical

    def centre(self, seconds: float) -> Array:
        """Where it is; only between ``start`` and ``end``."""
        at = (seconds - self.start) / (self.end - self.start) * (len(self.points) - 1)
        low = int(np.clip(np.floor(at), 0, len(self.points) - 2))
        return self.points[low] + (at - low) * (self.points[low + 1] - self.points[low])

    def world_from_object(self, seconds: float) -> Array:
        """Pose (4, 4); the object's y axis is the vertical."""
        side = np.cross(self.up, [0.31, 0.17, 0.93])
        side /= np.linalg.norm(side)
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([side, self.up, np.cross(side, self.up)])
        turn = se3_exp(np.r_[0.0, 0.0, 0.0, 0.0, self.yaw_rate * seconds, 0.0])
        pose = pose @ turn
        pose[:3, 3] = self.centre(seconds)
        return pose


def texture(seed: int, contrast: float, size: int = 512) -> NDArray[np.uint8]:
    """A picture (size, size, 3) full of corners at several scales; ``contrast`` 0..1."""
    rng = np.random.default_rng(seed)
    picture = np.zeros((size, size, 3), np.float32)
    base = rng.uniform(70, 180, 3)
    for cells, share in ((8, 0.5), (24, 0.35), (64, 0.25)):
        grid = rng.uniform(-1, 1, (cells, cells, 1)) + 0.4 * rng.uniform(-1, 1, (cells, cells, 3))
        picture += share * cv2.resize(grid.astype(np.float32), (size, size), interpolation=cv2.INTER_NEAREST)
    for _ in range(60):
        x, y = rng.integers(0, size, 2).tolist()
        cv2.circle(picture, (x, y), int(rng.integers(3, 22)), rng.uniform(-1, 1, 3).tolist(), -1)
    painted = np.clip(base + 110.0 * contrast * picture, 0, 255).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(painted, (3, 3), 0.6), np.uint8)


def hits(shape: str, half: Array, origin: Array, rays: Array) -> Array:
    """Parameter (n,) of the first hit of rays (n, 3) from ``origin``, all in the object's frame; inf: a miss.

    A ray that starts inside misses.
    """
    if shape == ELLIPSOID:
        o, d = origin / half, rays / half
        a, b, c = np.einsum("ij,ij->i", d, d), d @ o, o @ o - 1.0
        if c <= 0:
            return np.full(len(rays), np.inf)
        root = b * b - a * c
        t = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)
        return np.where(t > 0, t, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-half - origin) / rays, (half - origin) / rays
    entry, leave = np.full(len(rays), -np.inf), np.full(len(rays), np.inf)
    for axis in range(3):
        np.fmax(entry, np.fmin(one[:, axis], other[:, axis]), out=entry)
        np.fmin(leave, np.fmax(one[:, axis], other[:, axis]), out=leave)
    return np.where((entry <= leave) & (entry > 0), entry, np.inf)


def surface(shape: str, half: Array, points: Array) -> tuple[Array, Array]:
    """Unit normals (n, 3) at surface points (n, 3), object frame, and texture places (n, 2) in [0, 1)."""
    unit = points / half
    if shape == ELLIPSOID:
        normals = unit / half
        u = np.arctan2(unit[:, 2], unit[:, 0]) / (2 * np.pi)
        v = np.arccos(np.clip(unit[:, 1], -1, 1)) / np.pi
    else:
        axis = np.abs(unit).argmax(axis=1)
        rows = np.arange(len(points))
        normals = np.zeros_like(points)
        normals[rows, axis] = np.sign(unit[rows, axis])
        u = (axis + 0.5 + 0.499 * unit[rows, (axis + 1) % 3]) / 3.0
        v = 0.5 + 0.499 * unit[rows, (axis + 2) % 3]
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return normals, np.stack([u % 1.0, v % 1.0], axis=1)


def draw(
    camera: Camera,
    world_from_camera: Array,
    seconds: float,
    objects: list[Distractor],
    true_depth: Array,
    textures: dict[int, NDArray[np.uint8]] | None,
    step: int = 1,
) -> tuple[Array, NDArray[np.float32]]:
    """Depth (h, w) of the objects that are nearer than the scene, inf elsewhere, and their colours.

    ``true_depth`` (h, w) is at every ``step``-th pixel. Without ``textures`` colours are empty.
    """
    height, width = true_depth.shape
    shown: Array = np.full((height, width), np.inf)
    colours = np.zeros((height, width, 3) if textures is not None else (0, 0, 3), np.float32)
    for thing in objects:
        if not thing.start <= seconds <= thing.end:
            continue
        object_from_camera = inverse(thing.world_from_object(seconds)) @ world_from_camera
        rows, columns = _bounds(camera, inverse(object_from_camera), thing.half_extents, height, width, step)
        if rows.size == 0 or columns.size == 0:
            continue
        x = (columns * step - camera.cx) / camera.fx
        y = (rows * step - camera.cy) / camera.fy
        rays = np.stack([*np.broadcast_arrays(x[None, :], y[:, None]), np.ones((len(y), len(x)))], axis=-1)
        rotation, origin = object_from_camera[:3, :3], object_from_camera[:3, 3]
        rays = rays.reshape(-1, 3) @ rotation.T
        z = hits(thing.shape, thing.half_extents, origin, rays)
        window = np.ix_(rows, columns)
        before = np.minimum(true_depth[window], shown[window]).ravel()
        seen = np.flatnonzero((z < before) & (z > NEAREST))
        at = rows[seen // len(columns)], columns[seen % len(columns)]
        shown[at] = z[seen]
        if textures is None:
            continue
        normals, place = surface(thing.shape, thing.half_extents, origin + z[seen, None] * rays[seen])
        picture = textures[thing.texture]
        texel = (place * len(picture)).astype(np.int64)
        light = 0.75 + 0.25 * (normals @ thing.world_from_object(seconds)[:3, :3].T @ LIGHT)
        colours[at] = picture[texel[:, 1], texel[:, 0]] * light[:, None]
    return shown, colours


def _bounds(
    camera: Camera, camera_from_object: Array, half: Array, height: int, width: int, step: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the grid that a box may cover."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = (signs * half) @ camera_from_object[:3, :3].T + camera_from_object[:3, 3]
    if corners[:, 2].max() < NEAREST:
        return np.arange(0), np.arange(0)
    if corners[:, 2].min() < NEAREST:
        return np.arange(height), np.arange(width)
    pixels = camera.project(corners) / step
    low, high = np.floor(pixels.min(axis=0)).astype(np.int64), np.ceil(pixels.max(axis=0)).astype(np.int64)
    return (
        np.arange(max(int(low[1]), 0), min(int(high[1]) + 1, height)),
        np.arange(max(int(low[0]), 0), min(int(high[0]) + 1, width)),
    )
