"""Furniture: boxes and sheets in an item's own frame (x along the wall, y into the room, z up, metres).

The origin is on the floor, in the middle of the item's back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from prism_edge.sources.sim import pictures
from prism_edge.sources.sim.textures import Colour, Painter, cloth, colour, cupboard, plain, wood


@dataclass(frozen=True)
class Part:
    """A box (size: x, y, z), or a sheet that lies flat where its height is 0."""

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    paints: dict[str, Painter]
    yaw: float = 0.0
    density: float = 220.0


@dataclass(frozen=True)
class Item:
    """Parts, and the floor they take: width along the wall, depth into the room."""

    width: float
    depth: float
    parts: list[Part]


@dataclass(frozen=True)
class Style:
    """Colours and materials that the furniture of one room shares."""

    timber: Colour
    lacquer: Colour
    metal: Colour
    fabric: Colour
    fabric_second: Colour
    weave: int

    @classmethod
    def random(cls, rng: np.random.Generator) -> Style:
        """A style of its own for each room."""
        return cls(
            timber=colour(rng.uniform(0.075, 0.115), rng.uniform(0.35, 0.65), rng.uniform(0.35, 0.85)),
            lacquer=colour(rng.random(), rng.uniform(0.02, 0.75), rng.uniform(0.35, 0.9)),
            metal=colour(0.6, 0.05, rng.uniform(0.5, 0.9)),
            fabric=colour(rng.random(), rng.uniform(0.2, 0.7), rng.uniform(0.25, 0.8)),
            fabric_second=colour(rng.random(), rng.uniform(0.1, 0.6), rng.uniform(0.3, 0.95)),
            weave=int(rng.integers(3)),
        )


Maker = Callable[[np.random.Generator, Style], Item]


def _board(paint: Painter) -> dict[str, Painter]:
    return dict.fromkeys(("front", "back", "side", "top", "bottom"), paint)


def clutter(
    rng: np.random.Generator,
    z: float,
    x: tuple[float, float],
    y: tuple[float, float],
    sheets: int,
    things: int,
) -> list[Part]:
    """What lies and stands about on a flat surface at height ``z``: sheets overlap, things keep apart."""
    parts = []
    for layer in range(sheets):
        size = (float(rng.uniform(0.16, 0.3)), float(rng.uniform(0.2, 0.34)), 0.0)
        paint: Painter = pictures.page if rng.random() < 0.5 else pictures.cover
        reach = 0.5 * np.hypot(size[0], size[1])
        if x[1] - x[0] <= 2 * reach or y[1] - y[0] <= 2 * reach:
            continue
        centre = (rng.uniform(x[0] + reach, x[1] - reach), rng.uniform(y[0] + reach, y[1] - reach))
        height = z + 0.002 + 0.003 * layer
        parts.append(Part((*centre, height), size, {"top": paint}, rng.uniform(-np.pi, np.pi), 520.0))
    top = z + 0.003 * (sheets + 1)  # things stand on the topmost sheet, so that bounds stay apart
    taken: list[tuple[float, float, float]] = []
    for _ in range(things):
        kind = int(rng.integers(3))
        if kind == 0:  # a packet
            size, paint = tuple(rng.uniform((0.08, 0.05, 0.1), (0.26, 0.16, 0.3))), pictures.carton
        elif kind == 1:  # a mug
            size, paint = (
                (0.085, 0.085, 0.1),
                plain(colour(rng.random(), rng.uniform(0, 0.6), rng.uniform(0.4, 1))),
            )
        else:  # a frame or book that stands
            size, paint = (
                (float(rng.uniform(0.15, 0.28)), 0.04, float(rng.uniform(0.18, 0.32))),
                pictures.cover,
            )
        reach = 0.5 * float(np.hypot(size[0], size[1])) + 0.01
        if x[1] - x[0] <= 2 * reach or y[1] - y[0] <= 2 * reach:
            continue
        cx, cy = (
            float(rng.uniform(x[0] + reach, x[1] - reach)),
            float(rng.uniform(y[0] + reach, y[1] - reach)),
        )
        if any(max(abs(cx - ox), abs(cy - oy)) < reach + other for ox, oy, other in taken):
            continue
        taken.append((cx, cy, reach))
        sides = {"front": paint, "side": paint, "back": paint, "top": plain(colour(rng.random(), 0.3, 0.6))}
        centre3 = (cx, cy, top + size[2] / 2)
        parts.append(Part(centre3, size, sides, rng.uniform(-0.6, 0.6), 420.0))
    return parts


def counter(rng: np.random.Generator, style: Style) -> Item:
    """Kitchen cupboards under a worktop with things on it, and cupboards on the wall above."""
    doors = int(rng.integers(2, 5))
    width, depth, height = 0.55 * doors, 0.6, 0.86
    front = cupboard(style.lacquer, doors, style.metal, int(rng.choice((1, 1, 3))))
    side = plain(style.lacquer)
    top = plain(colour(0.6, 0.1, rng.uniform(0.1, 0.6)), 0.10) if rng.random() < 0.6 else wood(style.timber)
    parts = [
        Part((0, 0.29, height / 2 + 0.04), (width, 0.56, height - 0.08), {"front": front, "side": side}),
        Part(
            (0, 0.3, height + 0.02), (width, 0.6, 0.04), {"front": top, "side": top, "top": top}, density=260
        ),
        Part((0, 0.26, 0.02), (width, 0.5, 0.04), {"front": plain(colour(0, 0, 0.15))}),
    ]
    inside = ((-width / 2, width / 2), (0.0, depth))
    parts += clutter(
        rng, height + 0.04, *inside, sheets=int(rng.integers(1, 4)), things=int(rng.integers(3, 8))
    )
    if rng.random() < 0.7:
        over = cupboard(style.lacquer, doors, style.metal)
        sides = {"front": over, "side": side, "bottom": side}
        parts.append(Part((0, 0.17, 1.75), (width, 0.33, 0.62), sides))
    return Item(width, depth, parts)


def bookcase(rng: np.random.Generator, style: Style) -> Item:
    """Open shelves with rows of books and a few other things."""
    width, depth, height = float(rng.uniform(0.8, 1.3)), 0.32, float(rng.uniform(1.1, 2.1))
    paint, count = wood(style.timber), max(3, round(height / 0.36))
    parts = [Part((0, 0.01, height / 2), (width - 0.04, 0.02, height), {"front": paint}, density=120)]
    for sign in (-1, 1):
        side = Part((sign * (width / 2 - 0.01), depth / 2, height / 2), (0.02, depth, height), _board(paint))
        parts.append(side)
    gap = (height - 0.03) / count
    for row in range(count + 1):
        z = 0.015 + row * gap
        parts.append(Part((0, depth / 2 + 0.01, z), (width - 0.042, depth - 0.022, 0.025), _board(paint)))
        if row < count:
            tall, room = (gap - 0.03) * rng.uniform(0.72, 0.95), width - 0.05
            share = rng.uniform(0.55, 1.0)
            place = rng.uniform(-0.5, 0.5) * room * (1 - share)
            sides = {
                "front": pictures.books,
                "side": plain(colour(rng.random(), 0.5, 0.4)),
                "top": pictures.page,
            }
            middle = (place, 0.12, z + 0.0135 + tall / 2)
            parts.append(Part(middle, (room * share, 0.19, tall), sides, density=430))
    return Item(width, depth, parts)


def desk(rng: np.random.Generator, style: Style) -> Item:
    """A table against the wall with a screen, papers, and a chair drawn up."""
    width, depth, height = float(rng.uniform(1.2, 1.7)), 0.7, 0.74
    top, metal = wood(style.timber), plain(style.metal)
    parts = [Part((0, 0.35, height - 0.015), (width, 0.7, 0.03), _board(top), density=260)]
    for sign in (-1, 1):
        parts.append(
            Part(
                (sign * (width / 2 - 0.03), 0.35, height / 2 - 0.02),
                (0.04, 0.6, height - 0.05),
                _board(metal),
            )
        )
    drawers = cupboard(style.lacquer, 1, style.metal, 3)
    sides = {"front": drawers, "side": plain(style.lacquer)}
    parts.append(Part((width / 2 - 0.28, 0.33, 0.34), (0.4, 0.5, 0.6), sides))
    screen = {"front": pictures.screen, "back": metal, "side": metal, "top": metal}
    x = float(rng.uniform(-0.25, 0.15))
    parts.append(
        Part((x, 0.14, height + 0.03), (0.2, 0.16, 0.06), {"front": metal, "side": metal, "top": metal})
    )
    parts.append(Part((x, 0.12, height + 0.24), (0.55, 0.04, 0.34), screen, density=420))
    inside = ((-width / 2, width / 2), (0.24, depth))
    parts += clutter(rng, height, *inside, sheets=int(rng.integers(2, 5)), things=int(rng.integers(1, 4)))
    seat = chair(style, (float(rng.uniform(-0.2, 0.1)), 0.98), np.pi)
    return Item(width, 1.25, parts + seat)


def chair(style: Style, place: tuple[float, float], yaw: float) -> list[Part]:
    """A chair whose back is behind its seat (-y when ``yaw`` is 0)."""
    timber, seat = wood(style.timber), cloth(style.fabric, style.fabric_second, style.weave)
    c, s = np.cos(yaw), np.sin(yaw)

    def put(x: float, y: float, z: float, size: tuple[float, float, float], paint: Painter) -> Part:
        centre = (place[0] + c * x - s * y, place[1] + s * x + c * y, z)
        return Part(centre, size, _board(paint), yaw, 200.0)

    parts = [put(0, 0, 0.44, (0.42, 0.42, 0.05), seat)]
    for x in (-0.18, 0.18):
        parts.append(put(x, 0.18, 0.205, (0.04, 0.04, 0.41), timber))
        parts.append(put(x, -0.18, 0.205, (0.04, 0.04, 0.41), timber))
        parts.append(put(x, -0.19, 0.685, (0.04, 0.03, 0.43), timber))
    for z in (0.6, 0.7, 0.84):
        parts.append(put(0, -0.19, z, (0.31, 0.02, 0.05 if z < 0.8 else 0.09), timber))
    return parts


def table(rng: np.random.Generator, style: Style) -> Item:
    """A table with chairs on its long sides, papers and crockery."""
    width, across, height = float(rng.uniform(1.1, 1.6)), float(rng.uniform(0.75, 0.9)), 0.75
    y = 0.5 + across / 2
    top = wood(style.timber, plank=60.0)
    parts = [Part((0, y, height - 0.02), (width, across, 0.04), _board(top), density=300)]
    for sx in (-1, 1):
        for sy in (-1, 1):
            place = (sx * (width / 2 - 0.06), y + sy * (across / 2 - 0.06), (height - 0.04) / 2)
            parts.append(Part(place, (0.08, 0.08, height - 0.04), _board(top)))
    inside = ((-width / 2, width / 2), (y - across / 2, y + across / 2))
    parts += clutter(rng, height, *inside, sheets=int(rng.integers(3, 7)), things=int(rng.integers(2, 5)))
    for x in (-0.28, 0.28):
        if rng.random() < 0.85:
            parts += chair(style, (x + rng.uniform(-0.04, 0.04), 0.24), 0.0)
        if rng.random() < 0.85:
            parts += chair(style, (x + rng.uniform(-0.04, 0.04), y + across / 2 + 0.26), np.pi)
    return Item(max(width, 1.1), across + 1.0, parts)


def sofa(rng: np.random.Generator, style: Style) -> Item:
    """A sofa with cushions."""
    width = float(rng.uniform(1.4, 2.1))
    cover = cloth(style.fabric, style.fabric_second, style.weave)
    body = {"front": cover, "side": cover, "top": cover}
    parts = [
        Part((0, 0.56, 0.22), (width - 0.36, 0.62, 0.44), body),
        Part((0, 0.13, 0.42), (width - 0.36, 0.24, 0.84), body),
        Part((-(width / 2 - 0.09), 0.44, 0.31), (0.18, 0.87, 0.62), body),
        Part((width / 2 - 0.09, 0.44, 0.31), (0.18, 0.87, 0.62), body),
    ]
    for x in (-0.3, 0.35):
        cushion = cloth(style.fabric_second, style.fabric, int(rng.integers(1, 3)))
        sides = {"front": cushion, "side": cushion, "top": cushion}
        parts.append(Part((x, 0.32, 0.62), (0.36, 0.1, 0.35), sides, density=260))
    return Item(width, 0.88, parts)


def cabinet(rng: np.random.Generator, style: Style) -> Item:
    """A sideboard or chest with things on top."""
    width, depth, height = float(rng.uniform(0.7, 1.4)), 0.45, float(rng.uniform(0.6, 1.1))
    front = cupboard(
        style.timber if rng.random() < 0.5 else style.lacquer, 2, style.metal, int(rng.integers(1, 4))
    )
    side = wood(style.timber)
    sides = {"front": front, "side": side, "top": side}
    parts = [Part((0, depth / 2, height / 2), (width, depth, height), sides, density=240)]
    inside = ((-width / 2, width / 2), (0.0, depth))
    parts += clutter(rng, height, *inside, sheets=int(rng.integers(0, 3)), things=int(rng.integers(2, 6)))
    return Item(width, depth, parts)


def cartons(rng: np.random.Generator, style: Style) -> Item:
    """A pile of boxes."""
    parts, z = [], 0.0
    for _ in range(int(rng.integers(2, 5))):
        size = (float(rng.uniform(0.3, 0.5)), float(rng.uniform(0.25, 0.4)), float(rng.uniform(0.2, 0.4)))
        paint: Painter = pictures.carton
        sides = dict.fromkeys(("front", "side", "back", "top"), paint)
        parts.append(Part((0, 0.27, z + size[2] / 2), size, sides, rng.uniform(-0.15, 0.15), 300))
        z += size[2] + 0.001
    return Item(0.6, 0.54, parts)


KINDS: dict[str, tuple[Maker, ...]] = {
    "kitchen": (counter, counter, counter, cabinet, bookcase),
    "office": (desk, bookcase, desk, cabinet, cartons),
    "living": (sofa, bookcase, cabinet, cabinet, desk),
    "library": (bookcase, bookcase, bookcase, desk, cabinet),
    "hall": (cabinet, cartons, bookcase),
}
