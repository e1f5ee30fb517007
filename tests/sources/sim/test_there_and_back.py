"""A walk there and back: where it begins and turns, how fast, how far aside, and which way it looks."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.sources.sim.there_and_back import ThereAndBack

START, END = np.array([1.0, -2.0, 1.5]), np.array([5.0, 1.0, 2.5])


def a_walk(speed: float = 0.5) -> ThereAndBack:
    return ThereAndBack(np.random.default_rng(4), START, END, speed, sway=0.2, swing=0.3, pitch=-0.1)


def test_it_is_at_the_ends_at_the_right_times_and_as_fast_as_asked() -> None:
    length = float(np.linalg.norm(END - START))
    for speed in (0.5, 1.0):
        walk = a_walk(speed)
        assert walk.period_s == pytest.approx(2 * length / speed)
        for seconds, place in ((0.0, START), (walk.period_s / 2, END), (walk.period_s, START)):
            away = walk.pose(seconds)[:3, 3] - place
            assert np.linalg.norm(away) < 0.2 + 0.06
            assert away @ (END - START) / length == pytest.approx(0.0, abs=0.06)  # aside and up, no farther


def test_it_stays_near_its_line_and_looks_along_it() -> None:
    walk = a_walk()
    poses = np.array([walk.pose(seconds) for seconds in np.arange(0.0, 40.0, 0.1)])
    along = (END - START)[:2] / np.linalg.norm((END - START)[:2])
    aside = (poses[:, :2, 3] - START[:2]) @ np.array([-along[1], along[0]])
    assert 0.1 < np.abs(aside).max() <= 0.2
    ahead = poses[:, :2, 2] / np.linalg.norm(poses[:, :2, 2], axis=1)[:, None]
    turned = np.arccos(np.clip(ahead @ along, -1.0, 1.0))
    assert 0.1 < turned.max() < 0.32  # backwards too: never turned round
    assert poses[:, 2, 2].mean() == pytest.approx(np.sin(-0.1), abs=0.08)


def test_it_moves_as_smoothly_as_a_hand() -> None:
    walk = a_walk()
    places = np.array([walk.pose(seconds)[:3, 3] for seconds in np.arange(0.0, 20.0, 1 / 30)])
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) * 30
    assert speeds.max() < 1.5
    assert np.linalg.norm(np.diff(places, 2, axis=0), axis=1).max() * 900 < 5.0  # m/s^2
