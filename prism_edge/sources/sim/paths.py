"""How the camera moves: smooth functions of time, defined for ever, that keep to free floor.

World frame: metres, z up. All randomness is in sums of sines whose frequencies and phases come from the
seed, so a pose at any time costs the same and needs no other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from prism_edge.geometry.poses import Array, from_rt
from prism_edge.sources.sim.floorplan import STEP, Plan, rounded, smoothed
from prism_edge.sources.sim.options import DRIVE, HANDHELD, STILL, STOPS, TURN, WHEELED

SPEEDS = {(HANDHELD, False): 0.22, (HANDHELD, True): 0.9}
SPEEDS |= {(WHEELED, False): 0.3, (WHEELED, True): 0.5, (STOPS, False): 0.3, (DRIVE, True): 9.0}
OVERLAP, DRIVEN_OVERLAP = 6.0, 40.0  # metres gone again after a lap, so that places are seen twice
_WAVES = 5  # of a wander
_LOOKAHEAD = 0.35  # m; people look where they will be
_TURN_RATE = 0.35  # rad/s
_SIDEWAYS, _BRAKING, _PACE_S = 2.5, 6.0, 0.3  # of a car: m/s^2 in a bend, m, s that it is early or late
_CORNER_S, _REST_S = 3.0, 0.5  # of a robot that turns on the spot, and before and after it


class CameraPath(Protocol):
    """A camera's pose at any time."""

    def pose(self, seconds: float) -> Array:
        """world_from_camera (4, 4)."""
        ...


class Wander:
    """Smooth noise in (-1, 1) about 0: sines of random frequency between ``low`` and ``high`` Hz."""

    def __init__(self, rng: np.random.Generator, low: float, high: float) -> None:
        share = (np.arange(_WAVES) + rng.random(_WAVES)) / _WAVES
        self._angular = 2 * np.pi * low * (high / low) ** share
        self._phase = rng.uniform(0, 2 * np.pi, _WAVES)
        # Slow waves are the large ones, as in any movement of a body.
        weight = self._angular**-0.5
        self._weight = weight / weight.sum()

    def __call__(self, seconds: float) -> float:
        return float(self._weight @ np.sin(self._angular * seconds + self._phase))


def looking(position: Array, yaw: float, pitch: float, roll: float) -> Array:
    """Pose (4, 4) of a camera that looks along ``yaw`` (from x to y), up by ``pitch``, and has ``roll``."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    level = np.array([[sy, cy * sp, cy * cp], [-cy, sy * sp, sy * cp], [0.0, -cp, sp]])  # right, down, ahead
    return from_rt(level @ np.array([[cr, -sr, 0.0], [sr, cr, 0.0], [0.0, 0.0, 1.0]]), position)


class HandheldInZone:
    """Someone looks about in one room with a camera in hand, turning mostly towards one side of it."""

    def __init__(self, rng: np.random.Generator, plan: Plan, speed: float) -> None:
        assert plan.zone is not None
        self._middle = plan.zone.mean(axis=0)
        self._half = (plan.zone[1] - plan.zone[0]) / 2
        self._place = [Wander(rng, 0.03, 0.12), Wander(rng, 0.03, 0.12), Wander(rng, 0.03, 0.15)]
        self._look = [Wander(rng, 0.03, 0.14), Wander(rng, 0.04, 0.2), Wander(rng, 0.05, 0.3)]
        self._tremor = [Wander(rng, 0.8, 3.0) for _ in range(6)]
        self._yaw = float(rng.uniform(-np.pi, np.pi))
        self._pace = 1.0
        times = np.arange(0.0, 300.0, 0.5)
        steps = np.diff([self._position(t) for t in times], axis=0)
        self._pace = speed * 0.5 / float(np.linalg.norm(steps, axis=1).mean())

    def _position(self, seconds: float) -> Array:
        x, y, z = (np.tanh(2.2 * wander(seconds * self._pace)) for wander in self._place)
        return np.array([*(self._middle + self._half * (x, y)), 1.42 + 0.17 * z])

    def pose(self, seconds: float) -> Array:
        """world_from_camera (4, 4)."""
        tremor = np.array([wander(seconds) for wander in self._tremor])
        yaw, pitch, roll = (wander(seconds) for wander in self._look)
        yaw = self._yaw + 1.1 * np.tanh(1.6 * yaw) + 0.012 * tremor[3]
        pitch = -0.22 + 0.3 * pitch + 0.012 * tremor[4]
        roll = 0.12 * roll + 0.010 * tremor[5]
        return looking(self._position(seconds) + 0.008 * tremor[:3], yaw, pitch, roll)


@dataclass(frozen=True)
class Ring:
    """A closed way on the floor, sampled at equal steps of its length."""

    points: Array  # (n, 2)
    heading: Array  # (n + 1,) rad, unwrapped: the last is the first and whole turns
    length: float

    @classmethod
    def of(cls, curve: Array, heading_sigma: float) -> Ring:
        """From dense points (n, 2) of a closed curve; headings are filtered over ``heading_sigma`` m."""
        steps = np.linalg.norm(np.roll(curve, -1, axis=0) - curve, axis=1)
        length = float(steps.sum())
        count = int(np.ceil(length / STEP))
        at = np.arange(count) * (length / count)
        travelled = np.concatenate([[0.0], np.cumsum(steps)])
        closed = np.concatenate([curve, curve[:1]])
        points = np.stack([np.interp(at, travelled, closed[:, k]) for k in (0, 1)], axis=1)
        ahead = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
        angle = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
        turns = round((angle[-1] - angle[0]) / (2 * np.pi)) * 2 * np.pi
        if heading_sigma:
            slope = np.arange(count) * (turns / count)
            angle = smoothed((angle - slope)[:, None], heading_sigma * count / length)[:, 0] + slope
        return cls(points, np.append(angle, angle[0] + turns), length)

    def at(self, metres: float) -> tuple[Array, float]:
        """Position (2,) and heading (rad) at a distance along the way, which may be many laps."""
        count = len(self.points)
        lap, share = divmod(metres / self.length, 1.0)
        row, rest = divmod(share * count, 1.0)
        i = int(row) % count
        position = (1 - rest) * self.points[i] + rest * self.points[(i + 1) % count]
        turns = self.heading[-1] - self.heading[0]
        heading = (1 - rest) * self.heading[i] + rest * self.heading[i + 1] + lap * turns
        return position, float(heading)


class HandheldOnRoute:
    """Someone walks a closed way with a camera in hand."""

    def __init__(self, rng: np.random.Generator, curve: Array, speed: float) -> None:
        self.ring = Ring.of(curve, 0.9)
        self._speed = speed
        self._start = float(rng.uniform(-1.8, -1.2))
        self._look = [Wander(rng, 0.05, 0.25), Wander(rng, 0.05, 0.3), Wander(rng, 0.05, 0.3)]
        self._sway = [Wander(rng, 0.1, 0.6) for _ in range(3)]
        self._tremor = [Wander(rng, 0.8, 3.0) for _ in range(3)]
        self._stride = 2 * np.pi * (0.85 * max(speed, 0.3))  # rad/s of a step with each foot, 0.6 m each

    def pose(self, seconds: float) -> Array:
        """world_from_camera (4, 4)."""
        metres = self._start + self._speed * seconds
        position, _ = self.ring.at(metres)
        _, heading = self.ring.at(metres + _LOOKAHEAD)
        sway = np.array([wander(seconds) for wander in self._sway])
        tremor = np.array([wander(seconds) for wander in self._tremor])
        yaw, pitch, roll = (wander(seconds) for wander in self._look)
        step = self._stride * seconds
        side = np.array([-np.sin(heading), np.cos(heading)]) * (0.05 * sway[0] + 0.012 * np.sin(step))
        height = 1.5 + 0.05 * sway[2] + 0.012 * np.sin(2 * step + 0.7)
        yaw = heading + 0.2 * yaw + 0.010 * np.sin(step) + 0.010 * tremor[0]
        pitch = -0.1 + 0.12 * pitch + 0.006 * np.sin(2 * step) + 0.008 * tremor[1]
        roll = 0.06 * roll + 0.008 * np.sin(step + 1.0) + 0.006 * tremor[2]
        return looking(np.array([*(position + side), height]), yaw, pitch, roll)


class Wheeled:
    """A robot follows a closed way: level, at one height, always looking where it drives."""

    def __init__(self, curve: Array, speed: float) -> None:
        self.ring = Ring.of(curve, 0.0)
        self._speed = speed

    def pose(self, seconds: float) -> Array:
        """world_from_camera (4, 4)."""
        position, heading = self.ring.at(-1.5 + self._speed * seconds)
        return looking(np.array([*position, 0.6]), heading, 0.0, 0.0)


class Driven:
    """A car follows a closed way: it slows down for bends, and sways a little on its springs."""

    def __init__(self, rng: np.random.Generator, curve: Array, speed: float) -> None:
        """``speed`` is that of straight roads, in m/s."""
        self.ring = Ring.of(curve, 1.0)
        step = self.ring.length / len(self.ring.points)
        bend = np.maximum(np.abs(np.diff(self.ring.heading)) / step, 1e-6)  # rad/m
        fast = _least_about(np.minimum(speed, np.sqrt(_SIDEWAYS / bend)), round(2.0 * _BRAKING / step))
        fast = smoothed(fast[:, None], _BRAKING / step)[:, 0]
        self._passed = np.concatenate([[0.0], np.cumsum(step / fast)])  # seconds, at each sample of the ring
        self._start = float(rng.uniform(0.05, 0.1)) * self.lap_s
        self._pace = Wander(rng, 0.02, 0.1)
        self._springs = [Wander(rng, 0.3, 2.0) for _ in range(3)]

    @property
    def lap_s(self) -> float:
        """How long once round takes."""
        return float(self._passed[-1])

    def pose(self, seconds: float) -> Array:
        """world_from_camera (4, 4)."""
        ahead = _PACE_S * (self._pace(seconds) - self._pace(0.0))
        lap, rest = divmod(self._start + seconds + ahead, self.lap_s)
        share = np.interp(rest, self._passed, np.arange(len(self._passed))) / len(self.ring.points)
        position, heading = self.ring.at((lap + float(share)) * self.ring.length)
        bounce, nod, roll = (spring(seconds) for spring in self._springs)
        place = np.array([*position, 1.65 + 0.02 * bounce])
        return looking(place, heading, 0.006 * nod, 0.008 * roll)


def _least_about(values: Array, reach: int) -> Array:
    """The least (n,) of a closed row of values (n,) within ``reach`` of each."""
    around = np.pad(values, reach, mode="wrap")[None]
    least: Array = cv2.erode(around, np.ones((1, 2 * reach + 1), np.uint8))[0, reach : reach + len(values)]
    return least


class StoppingToTurn:
    """A robot drives the sides of a rectangle; at each corner it stops and turns on the spot."""

    def __init__(self, corners: Array, speed: float) -> None:
        """``corners`` (4, 2), m, anticlockwise; ``speed`` is the mean along a side, in m/s."""
        self._corners = corners
        self._sides = np.roll(corners, -1, axis=0) - corners
        self._drives = np.linalg.norm(self._sides, axis=1) / speed

    def pose(self, seconds: float) -> Array:
        """world_from_camera (4, 4)."""
        lap, left = divmod(seconds, float((self._drives + _CORNER_S + 2 * _REST_S).sum()))
        side = 0
        while left >= self._drives[side] + _CORNER_S + 2 * _REST_S:
            left -= self._drives[side] + _CORNER_S + 2 * _REST_S
            side += 1
        position = self._corners[side] + _eased(left / self._drives[side]) * self._sides[side]
        turned = side + _eased((left - self._drives[side] - _REST_S) / _CORNER_S) + 4 * lap
        first = float(np.arctan2(self._sides[0, 1], self._sides[0, 0]))
        return looking(np.array([*position, 0.6]), first + turned * np.pi / 2, 0.0, 0.0)


def _eased(share: float) -> float:
    """From 0 at 0 and before to 1 at 1 and after, without a jerk at either end."""
    share = float(np.clip(share, 0.0, 1.0))
    return share - float(np.sin(2 * np.pi * share)) / (2 * np.pi)


class Turning:
    """A camera on a stand turns on the spot, or does not move at all (``rate`` 0)."""

    def __init__(self, place: Array, yaw: float, rate: float) -> None:
        self._place, self._yaw, self._rate = np.array([*place, 1.42]), yaw, rate

    def pose(self, seconds: float) -> Array:
        """world_from_camera (4, 4)."""
        return looking(self._place, self._yaw + self._rate * seconds, -0.15, 0.0)


def make_path(plan: Plan, kind: str, speed: float, seed: int) -> CameraPath:
    """The path of a kind (options.path) through a plan; ``speed`` 0 takes the usual one."""
    rng = np.random.default_rng([seed, 4])
    speed = speed or SPEEDS.get((kind, plan.route is not None), 0.0)
    if kind in (TURN, STILL):
        place = plan.zone.mean(axis=0) if plan.zone is not None else Ring.of(_curve(plan), 0.0).at(-1.5)[0]
        return Turning(place, float(rng.uniform(-np.pi, np.pi)), _TURN_RATE if kind == TURN else 0.0)
    if kind == STOPS:
        return StoppingToTurn(_corners(plan), speed)
    if kind == WHEELED:
        return Wheeled(_curve(plan), speed)
    if plan.route is not None and kind == DRIVE:
        return Driven(rng, plan.route, speed)
    if plan.route is not None:
        return HandheldOnRoute(rng, plan.route, speed)
    return HandheldInZone(rng, plan, speed)


def lap_length(path: CameraPath) -> float:
    """Metres of one lap, 0 for a path that has none."""
    ring = getattr(path, "ring", None)
    return ring.length if isinstance(ring, Ring) else 0.0


def _curve(plan: Plan) -> Array:
    if plan.route is not None:
        return plan.route
    return rounded(_corners(plan))


def _corners(plan: Plan) -> Array:
    assert plan.zone is not None
    (x0, y0), (x1, y1) = plan.zone
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
