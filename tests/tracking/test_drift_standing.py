"""A camera that stands trembles, and goes nowhere; one that is slow goes its way all the same."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.poses import from_rt, so3_exp
from prism_edge.tracking.drift import MOST_DETOUR, Drift
from tests.tracking.cloud import pose_at
from tests.tracking.drifting import CONFIG, result


def stand(drift: Drift, frames: int, tremble: float, depth: float = 2.0) -> None:
    """A camera that stands, its poses off by so much of the scene's depth, and so many radians."""
    rng, before = np.random.default_rng(5), np.eye(4)
    for _ in range(frames):
        pose = from_rt(so3_exp(tremble * rng.uniform(-1, 1, 3)), depth * tremble * rng.uniform(-1, 1, 3))
        drift.advance(before, result(pose), 0.0, depth=depth)
        before = pose


def test_a_camera_that_stands_does_not_walk_however_it_trembles():
    walks = []
    for frames in (300, 3000):
        drift = Drift(CONFIG)
        stand(drift, frames, 0.002)
        walks.append((drift.total.metres2, drift.total.radians2, drift.travelled))
    assert walks[1] == pytest.approx(walks[0], rel=0.1)
    most = MOST_DETOUR * np.array([0.02**2 * 0.02, 0.01**2 * np.radians(2.0), 0.02])
    assert np.all(np.array(walks[1]) <= most * 1.001), "that often 1 % of the depth, and 2 degrees"


def test_nor_does_one_that_stands_at_the_end_of_a_way():
    drift = Drift(CONFIG)
    drift.advance(np.eye(4), result(pose_at(5.0)), 0.0, depth=2.0)
    stand(drift, 1000, 0.002)
    most = MOST_DETOUR * 0.02 * 1.001
    assert 5.0 < drift.travelled <= 5.0 + most
    assert drift.total.metres2 <= 0.02**2 * (5.0 + most)


def test_a_slow_way_counts_in_full():
    """A millimetre a frame, and half a degree: both are less than what is taken for standing."""
    drift, before = Drift(CONFIG), np.eye(4)
    turns = from_rt(so3_exp(np.radians([0.0, 0.5, 0.0])), np.zeros(3))
    for step, metres2, radians2 in (
        (pose_at(0.001), 0.02**2 * 1.0, 0.0),
        (turns, 0.02**2 * 1.0, 0.01**2 * np.radians(500.0)),
    ):
        for _ in range(1000):
            drift.advance(before, result(before @ step), 0.0, depth=2.0)
            before = before @ step
        assert (drift.total.metres2, drift.total.radians2) == pytest.approx((metres2, radians2), rel=1e-6)
        assert drift.travelled == pytest.approx(1.0)


def test_neither_walk_nor_way_shrinks_where_the_camera_goes_back():
    drift, before, seen = Drift(CONFIG), np.eye(4), []
    for x in (0.005, 0.015, 0.005, 0.0, 0.4, 0.395, 0.4):
        drift.advance(before, result(pose_at(x)), 0.0, depth=2.0)
        before = pose_at(x)
        seen.append((drift.total.metres2, drift.travelled))
    # Nor where the scene comes near, beside which the way was none.
    for depth, x in ((100.0, 0.9), (100.0, 0.4), (100.0, 0.9), (100.0, 0.4), (1.0, 0.405)):
        drift.advance(before, result(pose_at(x)), 0.0, depth=depth)
        before = pose_at(x)
        seen.append((drift.total.metres2, drift.travelled))
    assert seen == sorted(seen)


def test_where_another_map_begins_the_camera_may_tremble_anew():
    drift, at = Drift(CONFIG), 0.0
    for _ in range(2):
        drift.advance(None, result(pose_at(at)), 0.0, depth=100.0)
        for _ in range(9):
            drift.advance(pose_at(at), result(pose_at(0.4 - at)), 0.0, depth=100.0)
            at = 0.4 - at
    assert drift.travelled == pytest.approx(18 * 0.4), "of each 4 m would count within 1 m of its beginning"
