"""A furnished room of textured rectangles, and the path of a hand-held camera through it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

TEXELS_PER_M = 160
# Luma stays within these, so that every depth's tint keeps R, G and B within 0..255 (tint.py).
DARKEST, BRIGHTEST = 75, 175


@dataclass(frozen=True)
class Face:
    """A rectangle: ``corner`` + u * ``right`` + v * ``down``, u in [0, width], v in [0, height], metres.

    ``right`` and ``down`` are unit vectors; the face is seen from the side its normal points to.
    """

    corner: F64
    right: F64
    down: F64
    width: float
    height: float
    normal: F64
    texture: NDArray[np.uint8]  # mip-map level 0: TEXELS_PER_M

    def corners(self) -> F64:
        """The four corners (4, 3), in order round the rectangle."""
        u, v = self.right * self.width, self.down * self.height
        return np.stack([self.corner, self.corner + u, self.corner + u + v, self.corner + v])


def block_texture(rng: np.random.Generator, width: int, height: int) -> NDArray[np.uint8]:
    """Random blocks of many sizes, one over the other: corners that stay put at every distance."""
    image = np.full((height, width), 125.0, np.float32)
    size = min(max(width, height), 320)
    while size >= 6:
        count = int(1.1 * width * height / size**2) + 1
        x, y = rng.integers(-size // 2, width, count), rng.integers(-size // 2, height, count)
        w, h = rng.integers(size // 2, size + 1, (2, count))
        values = rng.uniform(-1.0, 1.0, count)
        keep = rng.random(count) < 0.35
        for i in np.flatnonzero(keep):
            part = image[max(y[i], 0) : y[i] + h[i], max(x[i], 0) : x[i] + w[i]]
            part[:] = 0.35 * part + 0.65 * (125.0 + 60.0 * values[i])
        size //= 2
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    return np.clip(image, DARKEST, BRIGHTEST).astype(np.uint8)


def _face(rng: np.random.Generator, corner: F64, right: F64, down: F64) -> Face:
    width, height = float(np.linalg.norm(right)), float(np.linalg.norm(down))
    right, down = right / width, down / height
    texels = [max(8, int(np.ceil(extent * TEXELS_PER_M))) for extent in (width, height)]
    texture = block_texture(rng, *texels)
    return Face(corner, right, down, width, height, np.cross(down, right), texture)


def cuboid(rng: np.random.Generator, low: F64, high: F64, inside_out: bool = False) -> list[Face]:
    """The six faces of an axis-aligned box, seen from outside (or from inside: a room)."""
    faces = []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        ea, eb = np.zeros(3), np.zeros(3)
        ea[a], eb[b] = high[a] - low[a], high[b] - low[b]
        for at_high in (False, True):
            corner = low.copy()
            corner[axis] = (high if at_high else low)[axis]
            # cross(eb, ea) points to the low side; swap where the other side is wanted
            points_low = at_high if inside_out else not at_high
            right, down = (ea, eb) if points_low else (eb, ea)
            faces.append(_face(rng, corner, right, down))
    return faces


@lru_cache(maxsize=4)  # painting it takes longer than drawing some pictures of it
def furnished_room(seed: int) -> tuple[Face, ...]:
    """A room of 6 x 2.6 x 5 m (x right, y down, z forward; floor at y = 1.3) with boxes and a shelf."""
    rng = np.random.default_rng(seed)
    faces = cuboid(rng, np.array([-3.0, -1.3, -1.5]), np.array([3.0, 1.3, 3.5]), inside_out=True)
    boxes = (
        ((-1.6, 0.3, 1.9), (-0.7, 1.3, 2.7)),
        ((0.2, 0.7, 1.5), (1.0, 1.3, 2.2)),
        ((1.5, -0.5, 2.5), (2.4, 1.3, 3.2)),
        ((-2.8, -0.2, 0.6), (-2.2, 1.3, 1.8)),
        ((-0.6, -0.9, 3.0), (0.7, -0.3, 3.4)),
    )
    for low, high in boxes:
        faces += cuboid(rng, np.array(low), np.array(high))
    return tuple(faces)


def hand_held_path(frames: int, rate_hz: float) -> F64:
    """Poses (frames, 4, 4) ``world_from_camera``: a slow sway over about 1.5 m, looking into the room.

    It begins with a sideways movement, which is what a monocular start needs, and comes back on itself.
    """
    t = np.arange(frames) / rate_hz
    eye = np.stack(
        [
            0.75 * np.sin(0.9 * t) + 0.02 * np.sin(5.1 * t),
            0.18 * np.sin(0.7 * t + 0.6) - 0.10 + 0.012 * np.sin(6.3 * t + 1.0),
            -0.45 + 0.40 * np.sin(0.55 * t + 0.3) + 0.01 * np.sin(4.3 * t),
        ],
        axis=1,
    )
    aim = [0.55 * np.sin(0.6 * t + 0.4), 0.25 + 0.2 * np.sin(0.5 * t), np.full(frames, 2.8)]
    target = np.stack(aim, axis=1)
    roll = 0.05 * np.sin(0.8 * t) + 0.008 * np.sin(5.7 * t + 0.5)
    forward = target - eye
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(np.array([0.0, 1.0, 0.0]), forward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2] = c * right + s * down, c * down - s * right, forward
    poses[:, :3, 3] = eye
    return poses


def distances(points: F64, faces: Iterable[Face]) -> F64:
    """From points (n, 3) to the nearest of the faces (n,)."""
    best = np.full(len(points), np.inf)
    for face in faces:
        local = points - face.corner
        u, v = local @ face.right, local @ face.down
        over = np.maximum(0, np.maximum(-u, u - face.width)), np.maximum(0, np.maximum(-v, v - face.height))
        best = np.minimum(best, np.sqrt((local @ face.normal) ** 2 + over[0] ** 2 + over[1] ** 2))
    return best
