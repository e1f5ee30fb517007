"""A staircase between two walls, of equal steps, and the landings below and above it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prism_edge.messages import U8
from prism_edge.sources.sim.alike import repeated
from prism_edge.sources.sim.floorplan import Plan, Room
from prism_edge.sources.sim.shell import panel, walls
from prism_edge.sources.sim.surfaces import UP, Shop
from prism_edge.sources.sim.textures import colour, forget_sheets, plaster
from prism_edge.sources.sim.there_and_back import ThereAndBack
from prism_edge.sources.sim.world import Cell, World

LANDING = 3.0  # m, before the first step and behind the last
_HEADROOM, _EYES = 2.6, 1.45  # m
_DENSITY, _WALLS = 400.0, 150.0  # pixels a metre
_RAIL = (0.03, 0.03, 0.8)  # m, a baluster; two stand on each step
_CLIMBED = 0.62  # of the flight
USUAL_SPEED = 0.3  # m/s


@dataclass(frozen=True)
class Flight:
    """A seed's steps: how many, how deep and high, and how wide, m."""

    steps: int
    tread: float
    riser: float
    width: float

    @classmethod
    def of(cls, seed: int) -> Flight:
        """As houses have them."""
        rng = np.random.default_rng([seed, 1])
        steps = int(rng.integers(11, 16))
        return cls(steps, *(float(x) for x in rng.uniform((0.26, 0.15, 1.3), (0.31, 0.18, 2.0))))


def make_plan(seed: int) -> Plan:
    """The stairwell, the first step at x = 0; nobody else walks there."""
    flight = Flight.of(seed)
    low = np.array([-LANDING, -flight.width / 2])
    high = np.array([flight.steps * flight.tread + LANDING, flight.width / 2])
    return Plan((Room(low, high, flight.steps * flight.riser + _HEADROOM, "stairs"),), (), (), None, None)


def make_path(speed: float, seed: int) -> ThereAndBack:
    """Up most of the flight, and down again backwards, with the steps in view."""
    flight = Flight.of(seed)
    far = _CLIMBED * flight.steps * flight.tread
    start, end = np.array([-1.6, 0.0, _EYES]), np.array([far, 0.0, _EYES + far / flight.tread * flight.riser])
    rng = np.random.default_rng([seed, 4])
    return ThereAndBack(rng, start, end, speed or USUAL_SPEED, sway=0.18, swing=0.25, pitch=-0.3)


def build(plan: Plan, seed: int, unlike: float) -> World:
    """The world of such a plan; ``unlike`` (0 to 1) is how much each step differs from the others."""
    flight, room = Flight.of(seed), plan.rooms[0]
    textures: list[U8] = []
    shop = Shop(np.random.default_rng([seed, 2]), textures)
    rng = shop.rng
    stone, hue = [int(which) for which in rng.integers(2**31, size=5)], float(rng.random())
    base = colour(hue, 0.12, 0.58)
    tread = repeated(base, _DENSITY, unlike, stone[0], edge=(6, 12))
    riser = repeated(0.7 * base, _DENSITY, unlike, stone[1])
    rail = repeated(colour(hue + 0.4, 0.3, 0.3), _DENSITY, 0.0, stone[2])
    ground = repeated(0.85 * base, _WALLS, 1.0, stone[3])
    across = np.array([0.0, -flight.width, 0.0])
    left = np.array([0.0, flight.width / 2, 0.0])
    up, ahead = UP * flight.riser, np.array([flight.tread, 0.0, 0.0])
    for step in range(flight.steps):
        foot = step * (ahead + up) + left
        body = shop.new_body(foot + across, foot + ahead + up)
        shop.add(foot + up, across, -up, riser, _DENSITY, body)
        shop.add(foot + up + ahead, across, -ahead, tread, _DENSITY, body)
        for share in (0.25, 0.75):
            centre = foot + across + share * ahead + up + UP * (_RAIL[2] / 2) + np.array([0.0, 0.1, 0.0])
            shop.add_box(centre, np.array(_RAIL), 0.0, dict.fromkeys(("front", "side", "back", "top"), rail))
    top = flight.steps * (ahead + up) + left
    landing = np.array([LANDING, 0.0, 0.0])
    body = shop.new_body(top + across, top + landing)
    shop.add(top + landing, across, -landing, ground, _WALLS, body)
    shop.add(left, across, -landing, ground, _WALLS)
    for wall in walls(room, []):
        paint = plaster(colour(rng.random(), 0.06, 0.7), 0.03)
        if abs(wall.normal[0]) > 0.5:
            paint = repeated(colour(rng.random(), 0.2, 0.6), _WALLS, 1.0, stone[4])
        along, down = wall.along * wall.length, -UP * room.height
        panel(shop, wall.start + UP * room.height, along, down, paint, _WALLS, 2.0)
    low, high = np.array([*room.low, 0.0]), np.array([*room.high, room.height])
    along, white = np.array([high[0] - low[0], 0.0, 0.0]), plaster(colour(0.1, 0.05, 0.8), 0.02)
    panel(shop, low + UP * room.height, along, -across, white, _WALLS, 2.0)
    forget_sheets()
    return World((Cell(low, high, shop.done(), ()),), textures, plan)
