"""A corridor of equal doors: each stretch of it looks like the next, as in a hotel."""

from __future__ import annotations

import numpy as np

from prism_edge.messages import U8
from prism_edge.sources.sim.alike import repeated
from prism_edge.sources.sim.floorplan import Plan, Room
from prism_edge.sources.sim.shell import walls
from prism_edge.sources.sim.surfaces import DECAL, UP, Shop, upright
from prism_edge.sources.sim.textures import Painter, colour, forget_sheets
from prism_edge.sources.sim.there_and_back import ThereAndBack
from prism_edge.sources.sim.world import Cell, World

STRETCHES, EVERY = 12, 2.4  # doors on either side, and m from one to the next
_DOOR, _DOOR_AT = (1.0, 2.05), 1.2  # m: width and height, and its middle along a stretch
_PLATE, _PLATE_AT, _PLATE_UP = (0.25, 0.25), 0.42, 1.57  # m: a sign beside each door
_DENSITY = 200.0  # pixels a metre
_FROM, _TO = 2.5, 8.0  # m: from one end to where the walk begins, and from the other to where it turns
_EYES = 1.5  # m
USUAL_SPEED = 0.9  # m/s


def make_plan(seed: int) -> Plan:
    """The corridor; nobody else walks there."""
    rng = np.random.default_rng([seed, 1])
    size = np.array([STRETCHES * EVERY, rng.uniform(1.7, 2.1)])
    return Plan((Room(np.zeros(2), size, float(rng.uniform(2.4, 2.6)), "corridor"),), (), (), None, None)


def make_path(plan: Plan, speed: float, seed: int) -> ThereAndBack:
    """Down the corridor and back again, backwards, so that all is seen the same way round twice."""
    room = plan.rooms[0]
    middle = float(room.high[1] / 2)
    start, end = np.array([_FROM, middle, _EYES]), np.array([room.high[0] - _TO, middle, _EYES])
    rng = np.random.default_rng([seed, 4])
    return ThereAndBack(rng, start, end, speed or USUAL_SPEED, sway=0.25, swing=0.45, pitch=-0.08)


def build(plan: Plan, seed: int, unlike: float) -> World:
    """The world of such a plan; ``unlike`` (0 to 1) is how much each stretch differs from the others."""
    textures: list[U8] = []
    shop = Shop(np.random.default_rng([seed, 2]), textures)
    rng, room = shop.rng, plan.rooms[0]
    hues, own = rng.uniform(0.0, 1.0, 4).tolist(), rng.integers(2**31, size=5).tolist()

    def paint(number: int, value: float) -> Painter:
        return repeated(colour(hues[number], 0.25, value), _DENSITY, unlike, own[number])

    plaster, wood, carpet, ceiling = paint(0, 0.7), paint(1, 0.45), paint(2, 0.4), paint(3, 0.85)
    brass = repeated(colour(0.12, 0.25, 0.9), _DENSITY, 0.0, own[4])  # of the plates, which are all one
    low, high = np.array([*room.low, 0.0]), np.array([*room.high, room.height])
    across, along = np.array([0.0, high[1], 0.0]), np.array([EVERY, 0.0, 0.0])
    for stretch in range(STRETCHES):
        at = low + stretch * along
        shop.add(at + across, along, -across, carpet, _DENSITY)
        shop.add(at + UP * room.height, along, across, ceiling, _DENSITY)
    for wall in walls(room, []):
        if abs(wall.normal[0]) > 0.5:  # an end
            shop.add(
                wall.start + UP * room.height, wall.along * wall.length, -UP * room.height,
                repeated(colour(rng.random(), 0.2, 0.6), _DENSITY, 1.0, int(rng.integers(2**31))), _DENSITY,
            )  # fmt: skip
            continue
        for stretch in range(STRETCHES):
            foot = wall.start + wall.along * (stretch * EVERY)
            shop.add(foot + UP * room.height, wall.along * EVERY, -UP * room.height, plaster, _DENSITY)
            for size, middle, up, surface in (
                (_DOOR, _DOOR_AT, _DOOR[1] / 2, wood),
                (_PLATE, _PLATE_AT, _PLATE_UP, brass),
            ):
                centre = foot + wall.along * middle + UP * up + wall.normal * 0.002
                shop.add(*upright(centre, wall.normal, *size), surface, _DENSITY, DECAL)
    forget_sheets()
    return World((Cell(low, high, shop.done(), ()),), textures, plan)
