"""The shell of a room or doorway: floor, ceiling, walls with openings, trim, and what hangs on walls."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.messages import U8
from prism_edge.sources.sim import pictures
from prism_edge.sources.sim.floorplan import DOOR_HEIGHT, DOOR_WIDTH, WALL, Door, Room
from prism_edge.sources.sim.surfaces import DECAL, UP, Shop, upright
from prism_edge.sources.sim.textures import (
    Colour,
    Painter,
    carpet,
    ceiling,
    colour,
    plain,
    plaster,
    tiles,
    wood,
)

# Surfaces are cut up no larger than this (m), because each piece is drawn at one sharpness; most where
# they are seen at the flattest angles.
_FLOOR_PIECE, _WALL_PIECE, _CEILING_PIECE = 1.8, 3.0, 6.0
_SKIRTING = 0.09
_TRIM = 0.08


class Wall(NamedTuple):
    """One wall seen from inside its room: left end at the floor, direction to the right, inward normal."""

    start: Array  # (3,)
    along: Array  # (3,) unit
    normal: Array  # (3,) unit
    length: float
    openings: list[tuple[float, float]]  # doors, metres from the left


def walls(room: Room, doors: list[Door]) -> list[Wall]:
    """The four walls of a room."""
    out = []
    for axis in (0, 1):
        for side, sign in ((room.low, 1.0), (room.high, -1.0)):
            normal = np.zeros(3)
            normal[axis] = sign
            along = np.cross(UP, normal)
            across = 1 - axis
            start = np.zeros(3)
            start[axis] = side[axis]
            start[across] = (room.low if along[across] > 0 else room.high)[across]
            openings = []
            for door in doors:
                if door.axis == axis and abs(door.middle[axis] - side[axis]) < WALL:
                    middle = float((door.middle[across] - start[across]) * along[across])
                    openings.append((middle - DOOR_WIDTH / 2, middle + DOOR_WIDTH / 2))
            length = float((room.high - room.low)[across])
            out.append(Wall(start, along, normal, length, sorted(openings)))
    return out


def _pieces(length: float, longest: float) -> list[tuple[float, float]]:
    edges = np.linspace(0.0, length, max(1, int(np.ceil(length / longest))) + 1)
    return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


def panel(
    shop: Shop, origin: Array, right: Array, down: Array, paint: Painter, density: float, piece: float
) -> None:
    """One large rectangle, painted as a whole and cut along its pixels into pieces of ``piece`` m at most."""
    width, height = float(np.linalg.norm(right)), float(np.linalg.norm(down))
    columns, rows = max(8, round(width * density)), max(8, round(height * density))
    image = paint(shop.rng, rows, columns)
    for top, bottom in _pieces(height, piece):
        y0, y1 = round(top / height * rows), round(bottom / height * rows)
        for left, stop in _pieces(width, piece):
            x0, x1 = round(left / width * columns), round(stop / width * columns)
            corner = origin + right * (x0 / columns) + down * (y0 / rows)
            shop.add(corner, right * ((x1 - x0) / columns), down * ((y1 - y0) / rows), image[y0:y1, x0:x1])


def wall_paint(rng: np.random.Generator, kind: str, density: float) -> Painter:
    """What walls of this kind of room are covered with."""
    base = colour(rng.random(), rng.uniform(0.02, 0.18), rng.uniform(0.65, 0.95))
    if kind == "kitchen" and rng.random() < 0.7:
        return tiles(base, density * rng.uniform(0.1, 0.16), rng.choice((-0.25, 0.15)))
    return plaster(base, rng.uniform(0.015, 0.035))


def floor_paint(rng: np.random.Generator, kind: str, density: float) -> Painter:
    """What one walks on in this kind of room."""
    if kind == "kitchen":
        base = colour(rng.random(), rng.uniform(0.05, 0.3), rng.uniform(0.35, 0.75))
        return tiles(base, density * rng.uniform(0.25, 0.4), -0.3, 0.08)
    if kind in ("living", "library") or rng.random() < 0.3:
        base = colour(rng.uniform(0.05, 0.1), rng.uniform(0.35, 0.6), rng.uniform(0.35, 0.7))
        return wood(base, plank=density * 0.14, contrast=0.14)
    return carpet(
        colour(rng.random(), rng.uniform(0.05, 0.35), rng.uniform(0.25, 0.5)), bool(rng.random() < 0.6)
    )


def _with_skirting(paint: Painter, rows: int, base: Colour) -> Painter:
    def painted(rng: np.random.Generator, height: int, width: int) -> U8:
        image = paint(rng, height, width)
        image[-rows:] = plain(base)(rng, rows, width)
        image[-rows - 1] = image[-rows - 1] // 2
        return image

    return painted


def build_room(shop: Shop, room: Room, sides: list[Wall], shade: Callable[[Painter], Painter]) -> None:
    """Floor (``shade`` darkens it under furniture), ceiling, and walls with their openings and trim."""
    rng = shop.rng
    low, high = np.array([*room.low, 0.0]), np.array([*room.high, room.height])
    size = high - low
    ex, ey = np.array([1.0, 0, 0]) * size[0], np.array([0, 1.0, 0]) * size[1]
    panel(shop, low + ey, ex, -ey, shade(floor_paint(rng, room.kind, 130.0)), 130.0, _FLOOR_PIECE)
    white = colour(0.12, 0.04, rng.uniform(0.75, 0.9))
    above = ceiling(white, 60 * 0.6) if room.kind in ("office", "hall") else plaster(white, 0.012)
    panel(shop, low + UP * room.height, ex, ey, above, 60.0, _CEILING_PIECE)
    density = 120.0
    paint = wall_paint(rng, room.kind, density)
    skirting = colour(rng.uniform(0.05, 0.1), rng.uniform(0.0, 0.5), rng.uniform(0.2, 0.9))
    lower = _with_skirting(paint, round(_SKIRTING * density), skirting)
    trim = wood(colour(0.08, rng.uniform(0.1, 0.6), rng.uniform(0.35, 0.9)))
    for wall in sides:
        top = wall.start + UP * room.height
        edge = 0.0
        for left, right in wall.openings:
            before, above_door = wall.along * (left - edge), room.height - DOOR_HEIGHT
            panel(shop, top + wall.along * edge, before, -UP * room.height, lower, density, _WALL_PIECE)
            across = wall.along * (right - left)
            panel(shop, top + wall.along * left, across, -UP * above_door, paint, density, _WALL_PIECE)
            _door_trim(shop, wall, left, right, trim)
            edge = right
        rest = wall.along * (wall.length - edge)
        panel(shop, top + wall.along * edge, rest, -UP * room.height, lower, density, _WALL_PIECE)


def _door_trim(shop: Shop, wall: Wall, left: float, right: float, paint: Painter) -> None:
    yaw = float(np.arctan2(wall.normal[1], wall.normal[0]) - np.pi / 2)
    sides = {"front": paint, "side": paint, "top": paint, "bottom": paint}
    off = wall.start + wall.normal * 0.01
    for x in (left - _TRIM / 2, right + _TRIM / 2):
        centre = off + wall.along * x + UP * (DOOR_HEIGHT / 2)
        shop.add_box(centre, np.array([_TRIM, 0.02, DOOR_HEIGHT]), yaw, sides)
    centre = off + wall.along * ((left + right) / 2) + UP * (DOOR_HEIGHT + _TRIM / 2)
    shop.add_box(centre, np.array([right - left + 2 * _TRIM, 0.02, _TRIM]), yaw, sides)


def doorway_bounds(door: Door) -> tuple[Array, Array]:
    """Bounds (3,), (3,) of the small cell that a door makes through its wall."""
    half = np.full(2, DOOR_WIDTH / 2)
    half[door.axis] = WALL / 2
    return np.array([*(door.middle - half), 0.0]), np.array([*(door.middle + half), DOOR_HEIGHT])


def build_doorway(shop: Shop, door: Door) -> None:
    """Threshold, lintel and the two jambs."""
    low, high = doorway_bounds(door)
    size = high - low
    ex, ey = np.array([1.0, 0, 0]) * size[0], np.array([0, 1.0, 0]) * size[1]
    timber = wood(colour(0.08, 0.4, shop.rng.uniform(0.35, 0.8)))
    shop.add(low + ey, ex, -ey, timber, 150.0)
    shop.add(low + UP * size[2], ex, ey, timber, 150.0)
    across = 1 - door.axis
    for side, sign in ((low, 1.0), (high, -1.0)):
        normal = np.zeros(3)
        normal[across] = sign
        middle = (low + high) / 2
        middle[across] = side[across]
        shop.add(*upright(middle, normal, WALL, DOOR_HEIGHT), timber, 150.0)


def portal(door: Door, from_room: Room) -> Array:
    """The corners (4, 3) of the opening, in the plane of this room's wall."""
    low, high = doorway_bounds(door)
    axis = door.axis
    inside = (from_room.low + from_room.high)[axis] / 2
    plane = low[axis] if inside < door.middle[axis] else high[axis]
    corners = np.array([low, low, high, high])
    corners[1:3, 2] = high[2]
    corners[[0, 3], 2] = low[2]
    corners[:, axis] = plane
    return corners


def hang(shop: Shop, wall: Wall, height: float, share: float) -> None:
    """Posters, pictures, notices and a window now and then, side by side, on ``share`` of a wall."""
    rng = shop.rng
    x = float(rng.uniform(0.1, 0.5))
    while x < wall.length - 0.35:
        width = float(rng.choice((rng.uniform(0.22, 0.5), rng.uniform(0.5, 0.95))))
        paint, tall = pictures.poster, width * rng.uniform(0.7, 1.5)
        kind = rng.random()
        if kind < 0.12:
            paint, width, tall = pictures.window, float(rng.uniform(1.0, 1.6)), 1.1
        elif kind < 0.45:
            paint = pictures.photograph
        elif kind < 0.6:
            paint = pictures.page
        clear = all(x + width < left - 0.12 or x > right + 0.12 for left, right in wall.openings)
        if x + width < wall.length - 0.08 and clear and rng.random() < share:
            tall = min(tall, 1.15)
            z = float(rng.uniform(1.0 + tall / 2, min(height - 0.25, 2.25) - tall / 2 + 0.05))
            middle = wall.start + wall.along * (x + width / 2) + UP * z
            if kind < 0.12 or kind > 0.8:  # a frame stands out from the wall
                yaw = float(np.arctan2(wall.normal[1], wall.normal[0]) - np.pi / 2)
                edge = plain(colour(rng.random(), 0.2, rng.uniform(0.1, 0.9)))
                sides = {"front": paint, "side": edge, "top": edge, "bottom": edge}
                deep = np.array([width, 0.03, tall])
                shop.add_box(middle + wall.normal * 0.016, deep, yaw, sides, 300.0)
            else:
                corner = upright(middle + wall.normal * 0.002, wall.normal, width, tall)
                shop.add(*corner, paint, 330.0, DECAL)
        x += width + float(rng.uniform(0.08, 0.5))


def lamps(shop: Shop, room: Room) -> Array:
    """Positions (k, 3) of the lamps of a room."""
    size = room.high - room.low
    places = []
    for share in (0.3, 0.7) if size.max() > 4.5 else (0.5,):
        at = room.low + size / 2
        longer = int(np.argmax(size))
        at[longer] = room.low[longer] + share * size[longer]
        at = at + shop.rng.uniform(-0.3, 0.3, 2)
        places.append([*at, room.height - 0.05])
    return np.array(places)


def show_lamps(shop: Shop, places: Array) -> None:
    """Bright panels on the ceiling."""
    glow = plain(colour(0.13, 0.04, 1.0), 0.01)
    for place in places:
        corner = np.array([place[0] - 0.3, place[1] - 0.15, place[2] + 0.05 - 0.002])
        shop.add(corner, np.array([0.6, 0, 0]), np.array([0, 0.3, 0]), glow, 60.0, DECAL, bright=True)
