"""What a way across a narrow view is off by, a turn makes up for: drift of orientation."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from prism_edge.geometry.cameras import PINHOLE, Camera
from prism_edge.geometry.poses import from_rt, so3_exp
from prism_edge.tracking.baseline import NARROW, shift_as_turn
from prism_edge.tracking.drift import Drift
from tests.tracking.cloud import pose_at
from tests.tracking.drifting import CONFIG, World, result

SHARE, ALIKE = 0.05, 0.6
OF_MOTION = replace(CONFIG, drift_of_motion=SHARE, drift_per_sqrt_m=0.0, drift_per_sqrt_rad=0.0)


def camera(half_width: float, half_height: float) -> Camera:
    """Of 400 x 300 pixels; tangents of half its view."""
    return Camera(400, 300, 200.0 / half_width, 150.0 / half_height, 199.5, 149.5, PINHOLE)


def all_over(of: Camera) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(of.width), np.arange(of.height)), axis=-1).reshape(-1, 2) * 1.0


def gone(to: np.ndarray, depth: float, log_scale: float = 0.0) -> Drift:
    """The drift of a camera that has gone there in one step, beside a scene that far away (map units)."""
    drift = Drift(OF_MOTION)
    drift.advance(np.eye(4), replace(result(to), shift_as_turn=ALIKE), log_scale, depth=depth)
    return drift


@pytest.mark.parametrize("unit_m", [1.0, 3.0])
def test_a_way_across_the_view_is_off_by_an_angle_too(unit_m: float):
    total = gone(pose_at(0.3, 0.4), 2.0, np.log(unit_m)).total
    off_by = SHARE * 0.5 * unit_m * np.sqrt(min(1.0, 1.0 / (0.5 * unit_m)))
    assert total.sigmas() == pytest.approx((off_by, ALIKE * off_by / (2.0 * unit_m)))


def test_a_way_into_the_view_is_not_and_a_slanting_one_by_what_of_it_goes_across():
    assert gone(pose_at(0.0, 0.0, 0.5), 2.0).total.radians2 == 0.0
    slanting = gone(pose_at(0.3, 0.0, 0.4), 2.0).total
    assert np.sqrt(slanting.radians2 / slanting.metres2) == pytest.approx(ALIKE * 0.6 / 2.0)


def test_without_a_depth_nothing_is_said():
    total = gone(pose_at(0.5), 0.0).total
    assert total.radians2 == 0.0
    assert total.metres2 > 0.0


def test_keyframes_have_it_along_their_own_view_whichever_way_the_map_looks():
    """A camera that looks along x: what goes along x goes into its view."""
    for to, across in ((pose_at(0.5), 0.0), (pose_at(0.0, 0.0, 0.5), 1.0)):
        drift = Drift(OF_MOTION)
        world = World(drift)
        begin = from_rt(so3_exp(np.array([0.0, np.pi / 2, 0.0])), np.zeros(3))
        there = from_rt(begin[:3, :3], to[:3, 3])
        world.walk_to(0, begin, [])
        drift.advance(begin, replace(result(there), shift_as_turn=ALIKE), 0.0, depth=2.0)
        world.keyframes[1] = SimpleNamespace(id=1, world_from_camera=there, neighbours=[0])
        drift.add_keyframe(world, world.keyframes[1], 0.0)
        drift.advance(None, replace(result(there, 1), shift_as_turn=ALIKE), 0.0, depth=2.0)
        assert drift.here.metres2 > 0.0
        metres, radians = drift.here.sigmas()
        assert radians == pytest.approx(across * ALIKE * metres / 2.0)


def test_the_wider_points_lie_apart_the_less_a_turn_makes_up_for():
    wide, narrow = camera(0.8, 0.6), camera(0.2, 0.15)
    # Points all over a rectangle of half sides a, b are sqrt((a^2 + b^2) / 3) from its middle.
    assert shift_as_turn(wide, all_over(wide)) == pytest.approx(NARROW / np.sqrt(1.0 / 3.0), rel=0.01)
    assert shift_as_turn(narrow, all_over(narrow)) == 1.0
    aside = all_over(wide)
    aside = aside[(aside[:, 0] > 320) & (aside[:, 1] < 100)]
    assert shift_as_turn(wide, aside) == 1.0, "a corner of the view is a narrow one, wherever it lies"
    assert shift_as_turn(wide, np.zeros((0, 2))) == 1.0


def test_with_flattened_depths_a_shift_is_off_by_what_a_turn_makes_up_for():
    """Points whose depths a network has flattened, through a narrow view: 4 cm of 10 go into a turn."""
    rng, kept = np.random.default_rng(0), 0.6
    rays = np.column_stack([rng.uniform(-0.38, 0.38, 400), rng.uniform(-0.29, 0.29, 400), np.ones(400)])
    depth = rng.uniform(1.5, 3.0, 400)
    middle = np.median(depth)
    believed = 1.0 / (1.0 / middle + kept * (1.0 / depth - 1.0 / middle))
    seen = rays * depth[:, None] - (0.1, 0.0, 0.0)
    seen = seen[:, :2] / seen[:, 2:]
    moved, turned = 0.1, 0.0
    for _ in range(10):
        points = (rays * believed[:, None] - (moved, 0.0, 0.0)) @ so3_exp(np.array([0.0, turned, 0.0]))
        x, y, z = points.T
        by_shift = np.column_stack([-1.0 / z, np.zeros(400)])
        by_turn = np.column_stack([-(1.0 + (x / z) ** 2), -x * y / z**2])
        miss = (seen - points[:, :2] / z[:, None]).ravel()
        step = np.linalg.lstsq(np.column_stack([by_shift.ravel(), by_turn.ravel()]), miss, rcond=None)[0]
        moved, turned = moved + step[0], turned + step[1]
    off_by = abs(moved - 0.1)
    assert off_by > 0.03
    assert abs(turned) == pytest.approx(off_by / middle, rel=0.15)
