"""Streets between houses: a world as wide as roads are, for a camera on a car. Round one block, or a town."""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.messages import U8
from prism_edge.sources.sim import roadside, town
from prism_edge.sources.sim.floorplan import Plan, Room, rounded
from prism_edge.sources.sim.shell import Wall, panel, walls
from prism_edge.sources.sim.surfaces import DECAL, Shop
from prism_edge.sources.sim.textures import colour, forget_sheets, plain
from prism_edge.sources.sim.world import Cell, Portal, World

WIDTH, SKY = 16.0, 16.0  # m: from house to house, and up to where the sky is drawn
CROSSING = 20.0  # m, of a town: wider than its streets, so that a house's corner stands between any two
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


def make_town(seed: int) -> Plan:
    """Nine crossings, twelve streets, and a drive through all of them, through some twice."""
    rng = np.random.default_rng([seed, 1])
    sizes = rng.uniform(60.0, 120.0, (2, town.SIDE - 1))
    edges = [np.concatenate([[0.0], np.cumsum(CROSSING + row)]) for row in sizes]
    place = {node: np.array([edges[0][node[0]], edges[1][node[1]]]) for node in town.NODES}
    rooms = [Room(low, low + CROSSING, SKY, "street") for low in place.values()]
    for start, end in town.STREETS:
        axis = 0 if start[1] == end[1] else 1
        low, high = place[start].copy(), place[end].copy()
        low[axis] += CROSSING
        low[1 - axis] += (CROSSING - WIDTH) / 2
        high[1 - axis] = low[1 - axis] + WIDTH
        rooms.append(Room(low, high, SKY, "street"))
    corners = np.array([place[node] + CROSSING / 2 for node in town.tour(rng)])
    return Plan(tuple(rooms), (), (), None, rounded(corners, BEND))


def build_streets(plan: Plan, seed: int) -> World:
    """The world of such a plan and a seed: equal seeds give equal worlds, to the bit."""
    textures: list[U8] = []
    cells = []
    for number, room in enumerate(plan.rooms):
        shop = Shop(np.random.default_rng([seed, 2, number]), textures)
        beside = [(number + step) % len(plan.rooms) for step in (1, -1, *range(2, len(plan.rooms) - 1))]
        openings = [(_opening(room, plan.rooms[other]), other) for other in beside]
        portals = tuple(Portal(corners, other) for corners, other in openings if corners is not None)
        low, high = np.array([*room.low, 0.0]), np.array([*room.high, room.height])
        _ground_and_sky(shop, low, high)
        for wall in walls(room, []):
            for stretch in _closed(wall, portals):
                roadside.line_up(shop, stretch, room.height)
                roadside.park(shop, stretch)
        if np.ptp(room.high - room.low) > 1.0:  # a street, not a corner or crossing
            _mark_lines(shop, room)
        cells.append(Cell(low, high, shop.done(), portals))
    forget_sheets()
    return World(tuple(cells), textures, plan)


def _closed(wall: Wall, portals: tuple[Portal, ...]) -> list[Wall]:
    """The stretches of a wall that no portal opens."""
    spans = [(wall.length, wall.length)]
    for portal in portals:
        corners = portal.corners - wall.start
        if np.abs(corners @ wall.normal).max() < 1e-9:
            along = corners @ wall.along
            spans.append((float(along.min()), float(along.max())))
    x, out = 0.0, []
    for low, high in sorted(spans):
        if low - x > 1e-6:
            out.append(Wall(wall.start + wall.along * x, wall.along, wall.normal, low - x, []))
        x = high
    return out


def _opening(room: Room, other: Room) -> Array | None:
    """The corners (4, 3) of the side that two places share; None where they have no side in common."""
    low, high = np.maximum(room.low, other.low), np.minimum(room.high, other.high)
    shared = high - low
    if shared.min() < -1e-9 or shared.max() < 1e-9:
        return None
    return np.array([[*low, 0.0], [*low, SKY], [*high, SKY], [*high, 0.0]])


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
