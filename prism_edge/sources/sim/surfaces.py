"""Flat textured rectangles, the bodies they make up, and the light baked into their textures.

A surface is seen from the side where ``right`` points right and ``down`` points down; its other side is
never drawn. World frame: metres, z up.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array
from prism_edge.messages import I64, U8
from prism_edge.sources.sim.textures import Painter

SHELL, DECAL = -2, -1  # bodies of a cell's own walls and of what is stuck flat on them
# Pixels round a texture that repeat its edge, for samples that fall a little outside.
MARGIN = 4
_SMALLEST, _LARGEST = 8, 1024  # pixels of a texture's side
UP = np.array([0.0, 0.0, 1.0])


class Surfaces(NamedTuple):
    """Rectangles (n) of one cell: corner, its two edges (m), texture, and the body each belongs to."""

    origin: Array  # (n, 3), the corner that is top left to who sees it
    right: Array  # (n, 3)
    down: Array  # (n, 3)
    normal: Array  # (n, 3) towards the side that is seen, as long as the rectangle is large
    texture: I64  # (n,) row in the world's textures
    body: I64  # (n,) row in body_low, or SHELL or DECAL
    body_low: Array  # (bodies, 3) axis-aligned bounds
    body_high: Array  # (bodies, 3)

    def at(self, rows: NDArray[np.int64]) -> Surfaces:
        """Some of the rectangles; all bodies keep their numbers."""
        return self._replace(
            origin=self.origin[rows],
            right=self.right[rows],
            down=self.down[rows],
            normal=self.normal[rows],
            texture=self.texture[rows],
            body=self.body[rows],
        )

    def joined(self, other: Surfaces) -> Surfaces:
        """These and then those of ``other``, all of whose rectangles belong to bodies."""
        return Surfaces(
            np.concatenate([self.origin, other.origin]),
            np.concatenate([self.right, other.right]),
            np.concatenate([self.down, other.down]),
            np.concatenate([self.normal, other.normal]),
            np.concatenate([self.texture, other.texture]),
            np.concatenate([self.body, other.body + len(self.body_low)]),
            np.concatenate([self.body_low, other.body_low]),
            np.concatenate([self.body_high, other.body_high]),
        )


@dataclass(frozen=True)
class Light:
    """Lamps of one room, what every surface gets anyway, and the room's bounds for its dark corners."""

    lamps: Array  # (k, 3)
    ambient: float
    low: Array  # (3,)
    high: Array  # (3,)

    def at(self, points: Array, normal: Array) -> Array:
        """Brightness (n,), about 1 in the middle of a room, of points (n, 3) on a surface with ``normal``."""
        brightness = np.full(len(points), self.ambient)
        for lamp in self.lamps:
            ray = lamp - points
            distance = np.linalg.norm(ray, axis=1)
            facing = np.maximum(0.0, (ray @ normal) / np.maximum(distance, 1e-6))
            brightness += (
                1.1 * (0.25 + 0.75 * facing) / (1.0 + (distance / 2.2) ** 2) / np.sqrt(len(self.lamps))
            )
        for axis in range(3):
            for bound in (self.low[axis], self.high[axis]):
                if abs(normal[axis]) < 0.9:
                    brightness *= 1.0 - 0.22 * np.exp(-np.abs(points[:, axis] - bound) / 0.18)
        return brightness


def lit(image: U8, brightness: Array) -> U8:
    """An image (h, w, 3) times a coarse map of brightness stretched over it."""
    h, w = image.shape[:2]
    full = cv2.resize(brightness.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
    return np.clip(image * full[:, :, None], 0, 255).astype(np.uint8)


def with_margin(image: U8) -> U8:
    """An image with its edges repeated MARGIN times outwards."""
    return cv2.copyMakeBorder(image, MARGIN, MARGIN, MARGIN, MARGIN, cv2.BORDER_REPLICATE)


@dataclass
class Shop:
    """Collects surfaces of one cell; textures go to a list that the whole world shares."""

    rng: np.random.Generator
    textures: list[U8]
    light: Light | None = None
    _rows: list[tuple[Array, Array, Array, int, int]] = field(default_factory=list)
    _low: list[Array] = field(default_factory=list)
    _high: list[Array] = field(default_factory=list)

    def new_body(self, low: Array, high: Array) -> int:
        """A body with these bounds; its surfaces name the number returned."""
        self._low.append(np.asarray(low, dtype=np.float64))
        self._high.append(np.asarray(high, dtype=np.float64))
        return len(self._low) - 1

    def add(
        self,
        origin: Array,
        right: Array,
        down: Array,
        paint: Painter | U8,
        density: float = 200.0,
        body: int = SHELL,
        bright: bool = False,
    ) -> None:
        """One rectangle, painted at ``density`` pixels a metre; ``bright`` ones give their own light."""
        width, height = float(np.linalg.norm(right)), float(np.linalg.norm(down))
        if isinstance(paint, np.ndarray):
            image = paint
        else:
            columns, rows = (int(np.clip(round(s * density), _SMALLEST, _LARGEST)) for s in (width, height))
            image = paint(self.rng, rows, columns)
        if self.light is not None and not bright:
            normal = _cross(down, right) / (width * height)
            across, along = (np.linspace(0, 1, int(np.clip(s / 0.12, 2, 24))) for s in (width, height))
            a, b = np.meshgrid(across, along)
            points = origin + a.reshape(-1, 1) * right + b.reshape(-1, 1) * down
            image = lit(image, self.light.at(points, normal).reshape(a.shape))
        self.textures.append(
            with_margin(cv2.cvtColor(image, cv2.COLOR_BGR2BGRA))
        )  # four channels warp fastest
        self._rows.append((origin, right, down, len(self.textures) - 1, body))

    def add_box(
        self,
        centre: Array,
        size: Array,
        yaw: float,
        paints: dict[str, Painter],
        density: float = 200.0,
    ) -> None:
        """A box turned by ``yaw`` (rad) about z. ``paints`` has front (+y), back, side (+-x), top, bottom.

        A side without a painter is not there: nobody will see it.
        """
        half = np.asarray(size, dtype=np.float64) / 2
        ex = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        ey = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        reach = np.abs(ex) * half[0] + np.abs(ey) * half[1] + UP * half[2]
        body = self.new_body(centre - reach, centre + reach)
        for name, paint in paints.items():
            for origin, right, down in _sides(name, np.asarray(centre), half, ex, ey):
                self.add(origin, right, down, paint, density, body)

    def done(self) -> Surfaces:
        """Everything collected, as arrays."""
        origin, right, down, texture, body = zip(*self._rows, strict=True)
        return Surfaces(
            np.array(origin),
            np.array(right),
            np.array(down),
            np.cross(down, right),
            np.array(texture, dtype=np.int64),
            np.array(body, dtype=np.int64),
            np.array(self._low).reshape(-1, 3),
            np.array(self._high).reshape(-1, 3),
        )


def upright(middle: Array, normal: Array, width: float, height: float) -> tuple[Array, Array, Array]:
    """(origin, right, down) of a vertical rectangle about ``middle`` that faces along ``normal``."""
    right = np.array([-normal[1], normal[0], 0.0]) * width
    down = -UP * height
    return middle - right / 2 - down / 2, right, down


def _cross(a: Array, b: Array) -> Array:
    """np.cross of two vectors, without what it spends on other shapes."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _sides(name: str, centre: Array, half: Array, ex: Array, ey: Array) -> list[tuple[Array, Array, Array]]:
    x, y, z = ex * half[0], ey * half[1], UP * half[2]
    if name == "front":
        return [upright(centre + y, ey, 2 * half[0], 2 * half[2])]
    if name == "back":
        return [upright(centre - y, -ey, 2 * half[0], 2 * half[2])]
    if name == "side":
        return [upright(centre + s * x, s * ex, 2 * half[1], 2 * half[2]) for s in (1.0, -1.0)]
    if name == "top":
        return [(centre + z - x + y, 2 * x, -2 * y)]
    return [(centre - z - x - y, 2 * x, 2 * y)]
