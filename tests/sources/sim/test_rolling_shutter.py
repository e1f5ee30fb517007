"""A rolled picture against closed forms: where a bar on a wall is seen at the time of each row."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, from_rt, so3_exp
from prism_edge.sources.sim.rolling_shutter import rolled
from prism_edge.sources.sim.source import SimSource

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
SECONDS = 1.5
ADDRESS = "sim:room?seed=2&noise=0&blur=0&exposure=0&speed=1&width=320&height=240"


def sliding(seconds: float) -> Array:
    return from_rt(np.eye(3), np.array([0.5 * (seconds - SECONDS), 0.0, 0.0]))


def turning(seconds: float) -> Array:
    return from_rt(so3_exp(np.array([0.0, 0.6 * (seconds - SECONDS), 0.0])), np.zeros(3))


def bar_of_each_row(pose_at: Callable[[float], Array], depth: float, readout_s: float) -> Array:
    """Column (h,) that an upright bar in the middle of a wall is at, once rolled."""
    bar = np.zeros((240, 320, 3), np.uint8)
    bar[:, 150:170] = 200
    depths = np.full((240, 320), depth, np.float32)
    out = rolled(bar, depths, CAMERA, pose_at, SECONDS, readout_s)[:, :, 0].astype(float)
    columns: Array = out @ np.arange(320) / out.sum(axis=1)
    return columns


@pytest.mark.parametrize("readout_s", [0.04, -0.02])
@pytest.mark.parametrize("depth", [1.0, 4.0])
def test_a_row_s_shift_is_the_way_since_the_middle(depth: float, readout_s: float) -> None:
    late_s = ((np.arange(240) + 0.5) / 240 - 0.5) * readout_s
    expected = 159.5 - 262.5 * 0.5 * late_s / depth
    assert bar_of_each_row(sliding, depth, readout_s) == pytest.approx(expected, abs=0.05)


def test_a_row_s_turn_is_that_since_the_middle() -> None:
    late_s = ((np.arange(240) + 0.5) / 240 - 0.5) * 0.04
    expected = 159.5 - 262.5 * np.tan(0.6 * late_s)
    assert bar_of_each_row(turning, 2.0, 0.04) == pytest.approx(expected, abs=0.05)


def test_a_camera_at_rest_rolls_nothing() -> None:
    expected = np.full(240, 159.5)
    assert bar_of_each_row(lambda _: np.eye(4), 2.0, 0.04) == pytest.approx(expected, abs=1e-6)


def test_a_source_rolls_about_the_middle_row_of_what_it_had_drawn_at_once() -> None:
    with SimSource(ADDRESS) as source, SimSource(f"{ADDRESS}&readout=40") as rolling:
        at_once, taken = (s.image(40).pixels.astype(float) for s in (source, rolling))
        assert np.array_equal(source.pose(40), rolling.pose(40))
    off = np.abs(taken - at_once).mean(axis=(1, 2))
    assert off[119:121].max() < 0.5
    assert min(off[:40].mean(), off[-40:].mean()) > 4 * off[110:130].mean()
