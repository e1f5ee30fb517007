"""A trembling camera whose map is in another unit; what a way after a long pause says of the speed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.tracking.drift import COHERENT_M, LONGEST_S, MOST_DETOUR, Drift
from tests.tracking.cloud import pose_at
from tests.tracking.drifting import CONFIG, World, result

OF_MOTION = replace(CONFIG, drift_of_motion=0.05)


def test_a_trembling_camera_walks_no_farther_whatever_the_map_s_unit_is() -> None:
    """The bound is of metres, as the walk is: a unit of 10 m hides a tenfold variance."""
    walks = []
    for metres_a_unit in (1.0, 10.0):
        drift, at = Drift(CONFIG), 0.0
        for _ in range(2000):
            drift.advance(pose_at(at), result(pose_at(0.003 - at)), np.log(metres_a_unit), depth=2.0)
            at = 0.003 - at
        walks.append(drift.total.metres2)
    most = MOST_DETOUR * 0.02 * 0.02**2
    assert walks == pytest.approx([most, 10.0 * most], rel=0.01)


def test_a_step_over_a_long_gap_says_nothing_of_the_speed() -> None:
    """Two metres in ten seconds are how far it was carried, not how fast it goes."""
    drift = Drift(CONFIG)
    for k in range(31):
        drift.advance(pose_at(k / 30.0), result(pose_at((k + 1) / 30.0)), 0.0, round(k / 30.0 * 1e9), 2.0)
    speed = drift._speed
    assert speed == pytest.approx(1.0)
    gap_ns = round((1.0 + LONGEST_S + 7.0) * 1e9)
    drift.advance(pose_at(1.0), result(pose_at(61.0)), 0.0, gap_ns, 2.0)
    assert drift._speed == speed


def test_a_way_between_places_is_off_by_its_share_though_the_camera_stands_now() -> None:
    """From a standing camera's keyframe a metre away it lies as unsure as by a slow walk there."""
    drift = Drift(OF_MOTION)
    world = World(drift)
    world.walk_to(0, np.eye(4), [])  # no stamps: no speed is known
    drift.advance(np.eye(4), result(pose_at(0.5), 0, pose_at(0.5)), 0.0)
    assert drift._speed == 0.0
    way = 0.5
    expected = way * (0.02**2 + 0.05**2 * min(way, COHERENT_M))
    assert drift.total.metres2 == pytest.approx(expected)
