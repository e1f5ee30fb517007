"""Puts furniture into a room: along the walls first, then tables where floor is left."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.messages import U8
from prism_edge.sources.sim.floorplan import Plan, Room
from prism_edge.sources.sim.furniture import KINDS, Item, Style, table
from prism_edge.sources.sim.shell import Wall
from prism_edge.sources.sim.surfaces import Shop
from prism_edge.sources.sim.textures import Painter

_GAP = 0.03
_OFF_WALL = 0.036  # m; frames on the wall are thinner
_TABLE_TRIES = 60


@dataclass(frozen=True)
class Placed:
    """An item where it stands: its origin on the floor (2,), yaw (rad), and the floor it takes."""

    item: Item
    origin: Array
    yaw: float
    low: Array
    high: Array


def arrange(rng: np.random.Generator, plan: Plan, room: Room, sides: list[Wall]) -> list[Placed]:
    """Chooses items and places for them that overlap neither each other nor what must stay free."""
    style = Style.random(rng)
    placed: list[Placed] = []
    for row in rng.permutation(len(sides)):
        wall = sides[row]
        x = float(rng.uniform(0.0, 0.15))
        while x < wall.length - 0.4:
            makers = KINDS[room.kind]
            item = makers[int(rng.integers(len(makers)))](rng, style)
            here = _against(wall, x + item.width / 2, item)
            if x + item.width < wall.length and _fits(here, wall, x, plan, room, placed):
                placed.append(here)
                x += item.width + float(rng.choice((_GAP, rng.uniform(0.05, 0.5))))
            else:
                x += 0.15
    if room.kind in ("kitchen", "living", "office"):
        for _ in range(_TABLE_TRIES):
            item = table(rng, style)
            yaw = float(rng.integers(4)) * np.pi / 2
            middle = rng.uniform(room.low + 0.8, room.high - 0.8)
            here = _standing(item, middle, yaw)
            if _free(here, plan, room, placed):
                placed.append(here)
                break
    return placed


def _standing(item: Item, origin: Array, yaw: float) -> Placed:
    right = np.array([np.cos(yaw), np.sin(yaw)])
    ahead = np.array([-right[1], right[0]])
    ends = np.array([origin - right * item.width / 2, origin + right * item.width / 2 + ahead * item.depth])
    return Placed(item, origin, yaw, ends.min(axis=0), ends.max(axis=0))


def _against(wall: Wall, x: float, item: Item) -> Placed:
    yaw = float(np.arctan2(wall.normal[1], wall.normal[0]) - np.pi / 2)
    origin = wall.start + wall.along * x + wall.normal * _OFF_WALL
    return _standing(item, origin[:2], yaw)


def _fits(here: Placed, wall: Wall, x: float, plan: Plan, room: Room, placed: list[Placed]) -> bool:
    beside_door = all(x + here.item.width < left - 0.15 or x > right + 0.15 for left, right in wall.openings)
    return beside_door and _free(here, plan, room, placed)


def _free(here: Placed, plan: Plan, room: Room, placed: list[Placed]) -> bool:
    inside = np.all(here.low > room.low - 1e-9) and np.all(here.high < room.high + 1e-9)
    apart = all(
        np.any(here.high < other.low + _GAP / 2) or np.any(here.low > other.high - _GAP / 2)
        for other in placed
    )
    return bool(inside and apart) and plan.is_clear(here.low, here.high)


def build(shop: Shop, placed: list[Placed]) -> None:
    """Makes the surfaces of all that was placed."""
    for thing in placed:
        c, s = np.cos(thing.yaw), np.sin(thing.yaw)
        for part in thing.item.parts:
            x, y, z = part.centre
            centre = np.array([thing.origin[0] + c * x - s * y, thing.origin[1] + s * x + c * y, z])
            yaw = thing.yaw + part.yaw
            shop.add_box(centre, np.asarray(part.size), yaw, part.paints, part.density)


@dataclass(frozen=True)
class FloorShade:
    """Wraps the floor's painter and darkens what lies under and beside furniture."""

    room: Room
    placed: tuple[Placed, ...]

    def __call__(self, paint: Painter) -> Painter:
        def painted(rng: np.random.Generator, height: int, width: int) -> U8:
            image = paint(rng, height, width)
            size = self.room.high - self.room.low
            shade = np.ones((height, width), dtype=np.float32)
            for thing in self.placed:
                low, high = ((p - self.room.low) / size for p in (thing.low, thing.high))
                x0, x1 = round(low[0] * width), round(high[0] * width)
                y0, y1 = round((1 - high[1]) * height), round((1 - low[1]) * height)
                shade[max(0, y0) : y1, max(0, x0) : x1] = 0.55
            shade = cv2.GaussianBlur(shade, (0, 0), width / size[0] * 0.09)
            return (image * shade[:, :, None]).astype(np.uint8)

        return painted
