"""The camera's ways: smooth, clear of everything, closed where they should be, and like real ones."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from prism_edge.geometry.poses import Array, rotation_angle
from prism_edge.sources.sim import SimSource, streets
from prism_edge.sources.sim.floorplan import Plan, make_plan, rounded, smoothed
from prism_edge.sources.sim.options import DRIVE, HANDHELD, STILL, STOPS, TURN, WHEELED
from prism_edge.sources.sim.paths import CameraPath, Driven, Ring, Wander, lap_length, looking, make_path

MOVING = [(several, kind) for several in (False, True) for kind in (HANDHELD, WHEELED)]


def path_of(several_rooms: bool, kind: str, seed: int = 0, speed: float = 0.0) -> CameraPath:
    return make_path(make_plan(several_rooms, seed), kind, speed, seed)


def poses(path: CameraPath, times: Array) -> Array:
    return np.array([path.pose(float(t)) for t in times])


def angles_between(way: Array) -> Array:
    """Angles (n - 1,) by which each pose (n, 4, 4) is turned from the one before, rad."""
    turned = np.swapaxes(way[:-1, :3, :3], 1, 2) @ way[1:, :3, :3]
    about = np.stack([turned[:, j, i] - turned[:, i, j] for i, j in ((0, 1), (1, 2), (2, 0))], axis=1)
    return np.arctan2(np.linalg.norm(about, axis=1), np.trace(turned, axis1=1, axis2=2) - 1)


def test_angles_between_are_those_of_one_pair_after_the_other() -> None:
    way = poses(path_of(False, TURN), np.array([0.0, 1e-4, 0.01, 1.0, 9.0]))
    one_by_one = [rotation_angle(a.T @ b) for a, b in itertools.pairwise(way[:, :3, :3])]
    assert angles_between(way) == pytest.approx(one_by_one, abs=1e-9)


def test_looking() -> None:
    ahead = looking(np.zeros(3), 0.0, 0.0, 0.0)[:3, :3]
    # looks along x: right is -y, down is -z
    assert ahead == pytest.approx(np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), abs=1e-12)
    up = looking(np.zeros(3), 0.0, 0.5, 0.0)[:3, 2]
    assert up == pytest.approx([np.cos(0.5), 0, np.sin(0.5)])
    rolled = looking(np.zeros(3), 0.7, -0.2, 0.3)[:3, :3]
    assert rolled @ rolled.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(rolled) == pytest.approx(1.0)
    level = looking(np.zeros(3), 0.7, -0.2, 0.0)[:3, :3]
    assert rotation_angle(level.T @ rolled) == pytest.approx(0.3)
    assert rolled[:, 2] == pytest.approx(level[:, 2])


def test_wander_stays_in_bounds_and_band() -> None:
    wander = Wander(np.random.default_rng(0), 0.1, 0.5)
    values = np.array([wander(t) for t in np.arange(0, 400, 0.1)])
    assert np.abs(values).max() < 1.0
    assert values.std() > 0.2
    power = np.abs(np.fft.rfft(values)) ** 2
    frequency = np.fft.rfftfreq(len(values), 0.1)
    assert power[(frequency > 0.09) & (frequency < 0.51)].sum() > 0.98 * power[1:].sum()


@pytest.mark.parametrize(("several", "kind"), MOVING)
@pytest.mark.parametrize("seed", [0, 1])
def test_motion_is_continuous_and_like_a_hand_or_a_robot(several: bool, kind: str, seed: int) -> None:
    path, step = path_of(several, kind, seed), 0.01
    way = poses(path, np.arange(0.0, 60.0, step))
    speed = np.linalg.norm(np.diff(way[:, :3, 3], axis=0), axis=1) / step
    usual = {(False, HANDHELD): 0.22, (False, WHEELED): 0.3, (True, HANDHELD): 0.9, (True, WHEELED): 0.5}
    assert speed.mean() == pytest.approx(usual[several, kind], rel=0.35)
    assert speed.max() < 1.2
    assert np.abs(np.diff(speed)).max() < 0.1  # no jerk: less than 10 m/s^2 at any time
    assert np.degrees(angles_between(way)).max() / step < 95.0


@pytest.mark.parametrize(("several", "kind"), MOVING)
def test_speed_is_the_one_asked_for(several: bool, kind: str) -> None:
    path = path_of(several, kind, speed=0.5)
    places = poses(path, np.arange(0.0, 200.0, 0.05))[:, :3, 3]
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).sum() / 200.0 == pytest.approx(0.5, rel=0.15)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("kind", [HANDHELD, WHEELED])
def test_the_ring_is_long_and_comes_back(seed: int, kind: str) -> None:
    path = path_of(True, kind, seed)
    lap = lap_length(path)
    assert lap >= 40.0
    seconds = lap / (0.9 if kind == HANDHELD else 0.5)
    first, again, half = path.pose(1.0), path.pose(1.0 + seconds), path.pose(1.0 + seconds / 2)
    assert np.linalg.norm(first[:3, 3] - again[:3, 3]) < 0.25
    assert np.degrees(rotation_angle(first[:3, :3].T @ again[:3, :3])) < 35.0
    assert np.linalg.norm(first[:3, 3] - half[:3, 3]) > 5.0


def test_a_sequence_of_the_ring_ends_where_it_began() -> None:
    source = SimSource("sim:loop?seed=3")
    _, way = source.truth()
    distance = np.linalg.norm(way[:, :3, 3] - way[0, :3, 3], axis=1)
    travelled = np.linalg.norm(np.diff(way[:, :3, 3], axis=0), axis=1).sum()
    assert travelled > 45.0
    assert distance[len(way) * 4 // 5 :].min() < 0.25
    assert distance.max() > 8.0


def test_a_robot_stays_level_and_looks_where_it_drives() -> None:
    for several in (False, True):
        way = poses(path_of(several, WHEELED), np.arange(0.0, 40.0, 0.01))
        assert np.ptp(way[:, 2, 3]) == 0.0
        assert np.abs(way[:, 2, 0]).max() < 1e-12  # right stays level
        assert way[:, 2, 1] == pytest.approx(-1.0)
        moved = np.diff(way[:, :3, 3], axis=0)
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        assert np.einsum("ni,ni->n", moved, way[:-1, :3, 2]).min() > np.cos(np.radians(2.0))


@pytest.mark.parametrize("seed", range(3))
def test_a_robot_that_stops_to_turn_moves_or_turns_and_never_both(seed: int) -> None:
    step = 0.01
    way = poses(path_of(False, STOPS, seed), np.arange(0.0, 200.0, step))
    moved = np.diff(way[:, :3, 3], axis=0)
    speed = np.linalg.norm(moved, axis=1) / step
    turned = np.degrees(angles_between(way)) / step
    drives, turns = speed > 1e-3, turned > 0.1
    assert not (drives & turns).any()
    assert turned.max() < 95.0
    assert np.abs(np.diff(speed)).max() < 0.02
    ahead = np.einsum("ni,ni->n", moved, way[:-1, :3, 2]) / step
    assert ahead[drives] == pytest.approx(speed[drives])  # it looks where it drives
    assert np.abs(way[:, 2, 0]).max() < 1e-12
    # Each stop is at a corner of the zone, and turns by a right angle to the left.
    zone = make_plan(False, seed).zone
    assert zone is not None
    edges = np.diff(turns.astype(int))
    begins, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    assert len(ends) > 4
    for a, b in zip(begins[: len(ends)], ends, strict=True):
        assert min(np.linalg.norm(way[a, :2, 3] - (x, y)) for x in zone[:, 0] for y in zone[:, 1]) < 1e-6
        angle = rotation_angle(way[a - 9, :3, :3].T @ way[b + 9, :3, :3])
        assert np.degrees(angle) == pytest.approx(90.0, abs=0.1)
        assert np.dot(way[b + 9, :3, 2], -way[a - 9, :3, 0]) > 0.99
    lap = 2 * np.ptp(zone, axis=0).sum() / 0.3 + 4 * 4.0
    assert path_of(False, STOPS, seed).pose(3.0 + lap) == pytest.approx(path_of(False, STOPS, seed).pose(3.0))


@pytest.mark.parametrize(
    ("plan", "seed", "speed"),
    [
        (streets.make_plan, 0, 0.0),
        (streets.make_plan, 1, 0.0),
        (streets.make_plan, 2, 4.0),
        (streets.make_plan, 2, 15.0),
        (streets.make_town, 1, 0.0),
    ],
)
def test_a_car_drives_smoothly_slows_down_for_bends_and_comes_back(
    plan: Callable[[int], Plan], seed: int, speed: float
) -> None:
    path = make_path(plan(seed), DRIVE, speed, seed)
    assert isinstance(path, Driven)
    usual, step = speed or 9.0, 0.01 if plan is streets.make_plan else 0.02  # a town's way is long
    assert lap_length(path) > 300.0
    way = poses(path, np.arange(0.0, 1.02 * path.lap_s, step))
    moved = np.diff(way[:, :3, 3], axis=0)
    fast = np.linalg.norm(moved, axis=1) / step
    turns = angles_between(way) / step
    assert np.median(fast[turns < 0.03]) == pytest.approx(usual, rel=0.1)
    assert fast.max() < 1.2 * usual
    assert np.abs(np.diff(fast)).max() < 10.0 * step  # m/s^2
    assert (fast * turns)[::10].max() < 4.0  # nor sideways
    assert 20.0 < np.degrees(turns.max()) < 50.0
    assert np.abs(way[:, 2, 3] - 1.65).max() < 0.03
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    assert np.einsum("ni,ni->n", moved, way[:-1, :3, 2]).min() > np.cos(np.radians(5.0))
    assert np.abs(way[:, 2, 0]).max() < 0.02  # hardly any roll
    away = np.linalg.norm(way[:, :3, 3] - way[0, :3, 3], axis=1)
    assert away.max() > 80.0
    assert away[len(way) * 9 // 10 :].min() < 0.2


def test_turning_and_standing() -> None:
    turning, still = path_of(False, TURN), path_of(True, STILL)
    assert np.array_equal(turning.pose(0.0)[:3, 3], turning.pose(9.0)[:3, 3])
    turned = turning.pose(0.0)[:3, :3].T @ turning.pose(1.0)[:3, :3]
    assert rotation_angle(turned) == pytest.approx(0.35, rel=0.02)
    assert np.array_equal(still.pose(0.0), still.pose(1e6))


def test_any_length() -> None:
    path = path_of(True, HANDHELD)
    for hours in (1, 1000):
        pose = path.pose(3600.0 * hours)
        assert np.isfinite(pose).all()
        assert np.linalg.norm(pose[:3, 3]) < 40.0


def clearance(source: SimSource) -> float:
    """Least distance of the camera from furniture and walls on the whole way (walls: within its cell)."""
    renderer, _ = source._opened()
    least = np.inf
    for position in source.truth()[1][::5, :3, 3]:
        for cell in renderer.world.cells:
            low, high = cell.surfaces.body_low, cell.surfaces.body_high
            outside = np.maximum(0.0, np.maximum(low - position, position - high))
            least = min(least, np.linalg.norm(outside, axis=1).min(initial=np.inf))
        cell = renderer.world.cells[renderer.world.cell_at(position)]
        sides = np.sort(np.concatenate([position - cell.low, cell.high - position]))
        # the way leaves through openings: at most two sides are near without being walls
        least = min(least, sides[2] if cell.portals else sides[0])
    return float(least)


def test_nothing_is_ever_near_the_camera(
    room: SimSource, loop: SimSource, street: SimSource, town_: SimSource
) -> None:
    assert clearance(street) > 1.5
    assert clearance(town_) > 1.5
    assert clearance(room) > 0.2
    assert clearance(loop) > 0.2


def test_rounding_a_square() -> None:
    square = np.array([[0.0, 0], [4, 0], [4, 4], [0, 4]])
    ring = Ring.of(rounded(square, 0.3), 0.0)
    assert 14.0 < ring.length < 16.0
    middle, heading = ring.at(2.0)  # of the first side
    assert middle[1] == pytest.approx(0.0, abs=0.02)
    assert heading == pytest.approx(0.0, abs=0.02)
    later, turned = ring.at(2.0 + 3 * ring.length)
    assert later == pytest.approx(middle, abs=1e-9)
    assert turned - heading == pytest.approx(6 * np.pi)
    before, after = ring.at(-0.001)[0], ring.at(0.001)[0]
    assert np.linalg.norm(before - after) == pytest.approx(0.002, rel=0.05)


def test_smoothing_is_a_gaussian_on_a_ring() -> None:
    spike = np.zeros((200, 1))
    spike[0] = 1.0
    out = smoothed(spike, 5.0)[:, 0]
    offsets = np.minimum(np.arange(200), 200 - np.arange(200))
    assert out == pytest.approx(np.exp(-0.5 * (offsets / 5.0) ** 2) / (5.0 * np.sqrt(2 * np.pi)), abs=1e-9)
