"""A whole simulated world from a kind and a seed: cells joined by portals, and their textures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.messages import U8
from prism_edge.sources.sim import furnish, shell
from prism_edge.sources.sim.floorplan import Plan
from prism_edge.sources.sim.surfaces import Light, Shop, Surfaces
from prism_edge.sources.sim.textures import forget_sheets


@dataclass(frozen=True)
class Portal:
    """An opening of a cell, corners (4, 3), into another cell."""

    corners: Array
    into: int


@dataclass(frozen=True)
class Cell:
    """A box-shaped space, a room or a doorway. Convex, so its own walls never hide one another."""

    low: Array  # (3,)
    high: Array  # (3,)
    surfaces: Surfaces
    portals: tuple[Portal, ...]


@dataclass(frozen=True)
class World:
    """Cells (rooms in the plan's order, then doorways), BGRA textures with margins, and their plan."""

    cells: tuple[Cell, ...]
    textures: list[U8]
    plan: Plan

    def cell_at(self, point: Array) -> int:
        """The cell that a point (3,) is in, or is nearest to."""
        low = np.array([cell.low for cell in self.cells])
        high = np.array([cell.high for cell in self.cells])
        return int(np.argmin(np.maximum(low - point, point - high).max(axis=1)))


def build_world(plan: Plan, seed: int) -> World:
    """The world of a plan and a seed: equal seeds give equal worlds, to the bit."""
    textures: list[U8] = []
    cells = []
    for number, room in enumerate(plan.rooms):
        doors = [(d, door) for d, door in enumerate(plan.doors) if number in door.rooms]
        sides = shell.walls(room, [door for _, door in doors])
        shop = Shop(np.random.default_rng([seed, 2, number]), textures)
        lamps = shell.lamps(shop, room)
        low, high = np.array([*room.low, 0.0]), np.array([*room.high, room.height])
        shop.light = Light(lamps, float(shop.rng.uniform(0.38, 0.55)), low, high)
        placed = furnish.arrange(shop.rng, plan, room, sides)
        shell.build_room(shop, room, sides, furnish.FloorShade(room, tuple(placed)))
        shell.show_lamps(shop, lamps)
        share = 0.35 if room.kind == "hall" else 0.8
        for wall in sides:
            shell.hang(shop, wall, room.height, share)
        furnish.build(shop, placed)
        portals = tuple(Portal(shell.portal(door, room), len(plan.rooms) + d) for d, door in doors)
        cells.append(Cell(low, high, shop.done(), portals))
    for d, door in enumerate(plan.doors):
        shop = Shop(np.random.default_rng([seed, 3, d]), textures)
        shell.build_doorway(shop, door)
        low, high = shell.doorway_bounds(door)
        portals = tuple(Portal(shell.portal(door, plan.rooms[r]), r) for r in door.rooms)
        cells.append(Cell(low, high, shop.done(), portals))
    forget_sheets()
    return World(tuple(cells), textures, plan)
