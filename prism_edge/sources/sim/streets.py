"""Four streets round a block of houses: a world as wide as roads are, for a camera on a car."""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.messages import U8
from prism_edge.sources.sim import roadside
from prism_edge.sources.sim.floorplan import Plan, Room, rounded
from prism_edge.sources.sim.shell import panel, walls
from prism_edge.sources.sim.surfaces import DECAL, Shop
from prism_edge.sources.sim.textures import colour, forget_sheets, plain
from prism_edge.sources.sim.world import Cell, Portal, World

WIDTH, SKY = 16.0, 16.0  # m: from house to house, and up to where the sky is drawn
BEND = 4.0  # m; the way round a corner is rounded by a Gaussian of that
_PIECE, _SKY_PIECE = 4.0, 40.0
_MARK = np.array([2.0, 0.15])  # m, a line in the middle of the road
_MARK_EVERY = 6.0
# Street by street and corner by corner round the block, by the four lines that bound streets each way.
_RING = (
    ((0, 0), (1, 1)), ((1, 0), (2, 1)), ((2, 0), (3, 1)), ((2, 1), (3, 2)),
    ((2, 2), (3, 3)), ((1, 2), (2, 3)), ((0, 2), (1, 3)), ((0, 1), (1, 2)),
)  # fmt: skip


def make_plan(seed: int) -> Plan:
    """Four corners and the streets between them, and a way in the middle of the road; nobody walks there."""
    rng = np.random.default_rng([seed, 1])
    edges = [np.cumsum([0.0, WIDTH, length, WIDTH]) for length in rng.uniform((90.0, 60.0), (120.0, 90.0))]
    rooms = []
    for low, high in _RING:
        bounds = [np.array([edges[axis][corner[axis]] for axis in (0, 1)]) for corner in (low, high)]
        rooms.append(Room(bounds[0], bounds[1], SKY, "street"))
    corners = np.array([(room.low + room.high) / 2 for room in rooms[::2]])
    return Plan(tuple(rooms), (), (), None, rounded(corners, BEND))


def build_streets(plan: Plan, seed: int) -> World:
    """The world of such a plan and a seed: equal seeds give equal worlds, to the bit."""
    textures: list[U8] = []
    cells = []
    for number, room in enumerate(plan.rooms):
        shop = Shop(np.random.default_rng([seed, 2, number]), textures)
        beside = [(number + step) % len(plan.rooms) for step in (1, -1)]
        portals = tuple(Portal(_opening(room, plan.rooms[other]), other) for other in beside)
        low, high = np.array([*room.low, 0.0]), np.array([*room.high, room.height])
        _ground_and_sky(shop, low, high)
        for wall in walls(room, []):
            middle = wall.start + wall.along * wall.length / 2
            if any(np.ptp(p.corners @ wall.normal) < 1e-9 and _inside(middle, p.corners) for p in portals):
                continue
            roadside.line_up(shop, wall, room.height)
            roadside.park(shop, wall)
        if number % 2:  # between two corners
            _mark_lines(shop, room)
        cells.append(Cell(low, high, shop.done(), portals))
    forget_sheets()
    return World(tuple(cells), textures, plan)


def _inside(point: Array, corners: Array) -> bool:
    low, high = corners.min(axis=0) - 1e-9, corners.max(axis=0) + 1e-9
    return bool(np.all((point >= low) & (point <= high)))


def _opening(room: Room, other: Room) -> Array:
    """The corners (4, 3) of the side that two neighbours share."""
    low, high = np.maximum(room.low, other.low), np.minimum(room.high, other.high)
    corners = np.array([[*low, 0.0], [*low, SKY], [*high, SKY], [*high, 0.0]])
    return corners


def _ground_and_sky(shop: Shop, low: Array, high: Array) -> None:
    size = high - low
    ex, ey = np.array([size[0], 0.0, 0.0]), np.array([0.0, size[1], 0.0])
    panel(shop, low + ey, ex, -ey, roadside.asphalt, roadside.DENSITY, _PIECE)
    up = np.array([0.0, 0.0, size[2]])
    panel(shop, low + up, ex, ey, roadside.sky, 4.0, _SKY_PIECE)


def _mark_lines(shop: Shop, room: Room) -> None:
    size = room.high - room.low
    along = int(np.argmax(size))
    paint = plain(colour(0.0, 0.0, 0.95))
    mark = _MARK if along == 0 else _MARK[::-1]
    for x in np.arange(1.0, size[along] - _MARK[0], _MARK_EVERY):
        corner = (room.low + room.high) / 2 - mark / 2
        corner[along] = room.low[along] + x
        far = np.array([corner[0], corner[1] + mark[1], 0.0])
        right, down = np.array([mark[0], 0.0, 0.0]), np.array([0.0, -mark[1], 0.0])
        shop.add(far, right, down, paint, 1.5 * roadside.DENSITY, DECAL)
