"""What streets are lined with: fronts of houses and hedges, and before them cars, poles and bushes.

Painters as in textures.py: (generator, height, width) to BGR uint8 (h, w, 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.messages import U8
from prism_edge.sources.sim.shell import Wall, panel
from prism_edge.sources.sim.surfaces import UP, Shop
from prism_edge.sources.sim.textures import (
    Colour,
    Painter,
    colour,
    noise,
    plain,
    plaster,
    tiles,
    tinted,
    wood,
)

DENSITY = 40.0  # pixels a metre
_PIECE = 4.0  # m; each is drawn at one sharpness
_STOREY, _WINDOW_EVERY, _BRICK = 3.0, 2.5, 0.12  # m
_HEDGES, _BRICKS = 0.25, 0.6  # of fronts, one in four is greenery; up to here they are of brick
DEEPEST = 3.5  # m from the wall that anything stands within


def sky(rng: np.random.Generator, height: int, width: int) -> U8:
    """Bright, and as good as nothing on it."""
    return plain(colour(0.58, 0.08, 0.98), 0.003)(rng, height, width)


def asphalt(rng: np.random.Generator, height: int, width: int) -> U8:
    """A road: fine grain, darker and lighter stretches, cracks that were mended."""
    grain = 0.05 * noise(rng, height, width, (2, 4)) + 0.05 * noise(rng, height, width, (12, 40))
    image = tinted(colour(0.1, 0.03, rng.uniform(0.32, 0.42)), grain)
    for _ in range(height * width // 30_000):
        start = rng.integers((width, height))
        corners = start + np.cumsum(rng.integers(-90, 91, (4, 2)), axis=0)
        cv2.polylines(image, [corners.astype(np.int32)], False, (40, 40, 40), 1, cv2.LINE_AA)
    return image


def leaves(rng: np.random.Generator, height: int, width: int) -> U8:
    """Greenery, in light and shade."""
    green = colour(rng.uniform(0.2, 0.33), 0.5, rng.uniform(0.25, 0.5))
    return tinted(green, 0.35 * noise(rng, height, width, (2, 5, 12, 40)))


@dataclass(frozen=True)
class Front:
    """One house's front, or a tall hedge."""

    width: float
    height: float
    paint: Painter

    @classmethod
    def random(cls, rng: np.random.Generator) -> Front:
        """Of any kind."""
        height, kind = float(rng.uniform(5.0, 12.0)), rng.random()
        if kind < _HEDGES:
            return cls(float(rng.uniform(7.0, 15.0)), height, leaves)
        base = colour(rng.random(), rng.uniform(0.02, 0.35), rng.uniform(0.35, 0.9))
        surface = tiles(base, DENSITY * _BRICK, -0.25, 0.08) if kind < _BRICKS else plaster(base, 0.05)
        return cls(float(rng.uniform(7.0, 15.0)), height, _with_windows(surface))


def _with_windows(surface: Painter) -> Painter:
    def paint(rng: np.random.Generator, height: int, width: int) -> U8:
        image = surface(rng, height, width)
        storeys = max(1, int(height / DENSITY / _STOREY))
        columns = max(1, int(width / DENSITY / _WINDOW_EVERY))
        tall, wide = height / storeys, width / columns
        for row in range(storeys):
            top, bottom = int((row + 0.25) * tall), int((row + 0.75) * tall)
            for column in range(columns):
                left, right = int((column + 0.3) * wide), int((column + 0.7) * wide)
                if rng.random() < 0.1 or bottom - top < 10 or right - left < 10:
                    continue
                glass = colour(0.58, 0.2, rng.uniform(0.1, 0.5))
                image[top:bottom, left:right] = tinted(
                    glass, 0.15 * noise(rng, bottom - top, right - left, (4, 12))
                )
                frame = (220, 220, 220) if rng.random() < 0.6 else (60, 60, 60)
                cv2.rectangle(image, (left, top), (right, bottom), frame, 2)
                middle = (left + right) // 2
                cv2.line(image, (middle, top), (middle, bottom), frame, 1)
        return image

    return paint


def line_up(shop: Shop, wall: Wall, height: float) -> None:
    """Fronts side by side along a wall, and the sky above them up to ``height``."""
    x = 0.0
    while x < wall.length - 1e-6:
        front = Front.random(shop.rng)
        rest = wall.length - x
        width = rest if rest < front.width + 2.0 else front.width
        foot = wall.start + wall.along * x
        panel(
            shop, foot + UP * height, wall.along * width, -UP * (height - front.height), sky, 4.0, 4 * _PIECE
        )
        top, down = foot + UP * front.height, -UP * front.height
        panel(shop, top, wall.along * width, down, front.paint, DENSITY, _PIECE)
        x += width


def park(shop: Shop, wall: Wall) -> None:
    """Cars, poles and bushes before a wall, at most DEEPEST from it, with gaps between them."""
    rng = shop.rng
    yaw = float(np.arctan2(wall.normal[1], wall.normal[0]) - np.pi / 2)
    x = float(rng.uniform(1.0, 5.0))
    while True:
        size, off, front, top = _thing(rng)
        if x + size[0] > wall.length - 0.5:
            return
        centre = wall.start + wall.along * (x + size[0] / 2) + wall.normal * off + UP * (size[2] / 2)
        paints = {"front": front, "side": front, "top": top}
        shop.add_box(centre, size, yaw, paints, 1.5 * DENSITY)
        x += size[0] + float(rng.uniform(1.0, 9.0))


def _thing(rng: np.random.Generator) -> tuple[Array, float, Painter, Painter]:
    """Size (3,: along the wall, away from it, up), how far its middle is off the wall, sides and top."""
    kind = rng.random()
    if kind < 0.5:
        size = np.array([rng.uniform(3.8, 4.8), 1.75, rng.uniform(1.35, 1.9)])
        base = colour(rng.random(), rng.uniform(0.0, 0.6), rng.uniform(0.1, 0.95))
        return size, float(rng.uniform(2.2, 2.6)), _car(base), plain(base)
    if kind < 0.75:
        bark = wood(colour(0.08, 0.3, 0.5))
        return np.array([0.25, 0.25, rng.uniform(3.0, 7.0)]), float(rng.uniform(2.6, 3.3)), bark, bark
    size = np.array([rng.uniform(1.5, 4.0), 1.0, rng.uniform(1.0, 4.0)])
    return size, float(rng.uniform(0.8, 1.2)), leaves, leaves


def _car(base: Colour) -> Painter:
    def paint(rng: np.random.Generator, height: int, width: int) -> U8:
        image = plain(base)(rng, height, width)
        corners = (int(0.1 * width), int(0.08 * height)), (int(0.9 * width), int(0.42 * height))
        cv2.rectangle(image, *corners, (30, 30, 28), -1)
        cv2.line(image, (width // 2, 0), (width // 2, height), (20, 20, 20), 2)
        for x in (0.2, 0.8):
            wheel = (int(x * width), int(0.88 * height))
            cv2.circle(image, wheel, max(3, int(0.2 * height)), (15, 15, 15), -1)
        return image

    return paint
