"""Where rooms, doors, free floor and the camera's way are: everything but the furniture.

One room, or eight round a closed ring with a door between each and the next. Plans are drawn on the floor
(x, y in metres). What the camera and the walkers need is set aside first; furniture comes after and keeps
off it, so that no path can meet anything.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prism_edge.geometry.poses import Array

DOOR_WIDTH, DOOR_HEIGHT = 1.0, 2.08
WALL = 0.14  # thickness of the walls between rooms
ROUTE_CLEAR = 0.62  # nothing stands nearer to the camera's route than this
ZONE_CLEAR = 0.35  # ... nor nearer to the zone it moves in
BESIDE = 2.0  # m between a way that is followed and the walls
LANE_CLEAR = 0.38  # half the width that a walker needs
STEP = 0.01  # m between samples of a route
RING = ((0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1))


@dataclass(frozen=True)
class Room:
    """Bounds on the floor (2,), height, and what kind of room it is."""

    low: Array
    high: Array
    height: float
    kind: str  # kitchen | office | living | library | hall


@dataclass(frozen=True)
class Door:
    """An opening through the wall between two rooms; ``axis`` is the one that it is walked along."""

    rooms: tuple[int, int]
    axis: int
    middle: Array  # (2,), in the middle of the wall's thickness


@dataclass(frozen=True)
class Lane:
    """A stretch of floor where one walker walks to and fro."""

    room: int
    start: Array  # (2,)
    end: Array  # (2,)


@dataclass(frozen=True)
class Plan:
    """A floor plan. The camera moves in ``zone`` (low, high; one room) or along ``route`` (closed ring)."""

    rooms: tuple[Room, ...]
    doors: tuple[Door, ...]
    lanes: tuple[Lane, ...]
    zone: Array | None  # (2, 2)
    route: Array | None  # (n, 2) points of a closed curve every centimetre, in order of travel

    def is_clear(self, low: Array, high: Array) -> bool:
        """Whether the rectangle keeps off zone, route and lanes."""
        if self.zone is not None and _overlap(
            low, high, self.zone[0] - ZONE_CLEAR, self.zone[1] + ZONE_CLEAR
        ):
            return False
        if self.route is not None and rectangle_distance(low, high, self.route[::8]) < ROUTE_CLEAR:
            return False
        for lane in self.lanes:
            ends = np.stack([lane.start, lane.end])
            if _overlap(low, high, ends.min(axis=0) - LANE_CLEAR, ends.max(axis=0) + LANE_CLEAR):
                return False
        return True


def _overlap(low: Array, high: Array, other_low: Array, other_high: Array) -> bool:
    return bool(np.all(low < other_high) and np.all(other_low < high))


def rectangle_distance(low: Array, high: Array, points: Array) -> float:
    """Smallest distance of points (n, 2) from a rectangle, 0 inside."""
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(low - points, points - high)), axis=1).min())


def rounded(corners: Array, sigma: float = 0.5) -> Array:
    """Points (n, 2) every ``STEP`` m along a closed polygon (k, 2), filtered by a Gaussian of ``sigma`` m."""
    pieces = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        n = max(1, int(np.ceil(np.linalg.norm(b - a) / STEP)))
        pieces.append(a + (b - a) * (np.arange(n) / n)[:, None])
    return smoothed(np.concatenate(pieces), sigma / STEP)


def smoothed(rows: Array, sigma: float) -> Array:
    """Rows (n, k) of a closed curve, filtered along it by a Gaussian of ``sigma`` rows."""
    n = len(rows)
    frequency = np.fft.rfftfreq(n)[:, None]
    gain = np.exp(-2.0 * (np.pi * sigma * frequency) ** 2)
    return np.fft.irfft(np.fft.rfft(rows, axis=0) * gain, n, axis=0)


def make_plan(several_rooms: bool, seed: int) -> Plan:
    """The plan of a seed."""
    rng = np.random.default_rng([seed, 1])
    return ring(rng) if several_rooms else one_room(rng)


def room_about(extent: Array, ceiling: float, seed: int) -> Plan:
    """A single room in which a way of ``extent`` (2,) m and what stands along the walls have their places.

    It is ``ceiling`` m high or more. Nobody walks there.
    """
    usual = make_plan(False, seed)
    room, half = usual.rooms[0], extent / 2 + ROUTE_CLEAR - ZONE_CLEAR
    size = np.maximum(room.high, 2 * (half + BESIDE))
    middle = size / 2
    grown = Room(room.low, size, max(room.height, ceiling), room.kind)
    return Plan((grown,), (), (), np.stack([middle - half, middle + half]), None)


def one_room(rng: np.random.Generator) -> Plan:
    """A single room; the camera's zone lies inside a ring that walkers share with nobody."""
    size = np.array([rng.uniform(6.0, 7.0), rng.uniform(5.2, 6.2)])
    kind = str(rng.choice(("kitchen", "office", "living")))
    room = Room(np.zeros(2), size, float(rng.uniform(2.5, 2.9)), kind)
    middle = size / 2 + rng.uniform(-0.15, 0.15, 2)
    half = np.array([rng.uniform(1.0, 1.3), rng.uniform(0.75, 0.95)])
    zone = np.stack([middle - half, middle + half])
    reach = half + ZONE_CLEAR + LANE_CLEAR - 0.1
    corners = [middle + reach * np.array(sign) for sign in ((-1, 1), (1, 1), (1, -1), (-1, -1))]
    # Lanes end short of each other's, so that two walkers never meet at a corner.
    lanes: list[Lane] = []
    for a, b in ((corners[0], corners[1]), (corners[2], corners[3]), (corners[1], corners[2])):
        inset = (b - a) / np.linalg.norm(b - a) * (0.95 if len(lanes) == 2 else 0.15)
        lanes.append(Lane(0, a + inset, b - inset))
    return Plan((room,), (), tuple(lanes), zone, None)


def ring(rng: np.random.Generator) -> Plan:
    """Eight rooms round a block, each joined to the next by a door; the way round is 40 m and more."""
    edges = [np.concatenate([[0.0], np.cumsum(rng.uniform(5.15, 6.0, 3))]) for _ in range(2)]
    kinds = (
        list(rng.permutation(["kitchen", "office", "office", "living", "library", "living"])) + ["hall"] * 2
    )
    heights = rng.uniform(2.5, 2.8, 8)
    rooms = []
    for number, (column, row) in enumerate(RING):
        low = np.array([edges[0][column], edges[1][row]]) + WALL / 2
        high = np.array([edges[0][column + 1], edges[1][row + 1]]) - WALL / 2
        kind = kinds.pop(0) if number not in (3, 7) else "hall"
        rooms.append(Room(low, high, float(heights[number]), kind))
    doors = []
    for number, (column, row) in enumerate(RING):
        other = (number + 1) % 8
        axis = 0 if RING[other][1] == row else 1
        step = RING[other][axis] - (column, row)[axis]
        a, b = rooms[number], rooms[other]
        middle = np.empty(2)
        middle[axis] = (a.high if step > 0 else a.low)[axis] + step * WALL / 2
        across = 1 - axis
        low, high = max(a.low[across], b.low[across]), min(a.high[across], b.high[across])
        middle[across] = (low + high) / 2 + rng.uniform(-0.9, 0.9)
        doors.append(Door((number, other), axis, middle))
    route = _route(rooms, doors)
    return Plan(tuple(rooms), tuple(doors), _lanes(rng, rooms, route), None, route)


def _route(rooms: list[Room], doors: list[Door]) -> Array:
    """Through every door squarely, and across each room from one door to the next."""
    corners = []
    for number, door in enumerate(doors):
        before, after = rooms[door.rooms[0]], rooms[door.rooms[1]]
        direction = np.zeros(2)
        direction[door.axis] = np.sign((after.low + after.high - before.low - before.high)[door.axis])
        corners += [door.middle - 0.9 * direction, door.middle + 0.9 * direction]
        following = doors[(number + 1) % len(doors)]
        if following.axis != door.axis:  # turn where the two directions cross
            corner = door.middle.copy()
            corner[door.axis] = following.middle[door.axis]
            corners.append(corner)
    return rounded(np.array(corners))


def _lanes(rng: np.random.Generator, rooms: list[Room], route: Array) -> tuple[Lane, ...]:
    """At most one stretch of 1.2 to 2.4 m in each room, away from the route and the walls."""
    lanes = []
    for number, room in enumerate(rooms):
        for _ in range(80):
            along = int(rng.integers(2))
            half = np.zeros(2)
            half[along] = rng.uniform(0.6, 1.2)
            middle = rng.uniform(room.low + half + 0.45, room.high - half - 0.45)
            start, end = middle - half, middle + half
            low, high = np.minimum(start, end) - LANE_CLEAR, np.maximum(start, end) + LANE_CLEAR
            if rectangle_distance(low, high, route[::8]) > ROUTE_CLEAR:
                lanes.append(Lane(number, start, end))
                break
    return tuple(lanes)
