"""The turn between two frames against rays that were turned by a known one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, so3_exp
from prism_edge.tracking.features import Features
from prism_edge.tracking.turn_between import LEAST_CORNERS, turn_between

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)


def corners(pixels: Array, looks: Array) -> Features:
    return Features.build(pixels, np.zeros(len(pixels), np.intp), looks, CAMERA.width, CAMERA.height)


def two_frames(turn: Array, seed: int, count: int = 200) -> tuple[Array, Array, Array]:
    """Pixels before and now of far points seen by a camera that turned by ``turn``, and how they look."""
    rng = np.random.default_rng(seed)
    now = rng.uniform((60, 60), (580, 420), (count, 2))
    points = np.column_stack([(now - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx, np.ones(count)])
    looks = rng.integers(0, 2**63, (count, 4)).astype(np.uint64)
    return CAMERA.project(points @ so3_exp(turn).T), now, looks


turns = st.lists(st.floats(-0.1, 0.1), min_size=3, max_size=3).map(np.array)


@given(turns, st.integers(0, 100))
def test_a_turn_is_found_exactly(turn: Array, seed: int) -> None:
    before, now, looks = two_frames(turn, seed)
    found = turn_between(CAMERA, corners(before, looks), corners(now, looks))
    assert found == pytest.approx(turn, abs=1e-9)


@given(turns, st.integers(0, 20))
def test_what_moves_by_itself_and_wrong_matches_weigh_little(turn: Array, seed: int) -> None:
    before, now, looks = two_frames(turn, seed)
    rng = np.random.default_rng(seed)
    before += rng.normal(0.0, 0.5, before.shape)
    before[:50] += (40.0, 0.0)  # a quarter goes its own way
    before[50:80] = rng.uniform((0, 0), (640, 480), (30, 2))
    found = turn_between(CAMERA, corners(before, looks), corners(now, looks))
    assert found is not None
    assert np.abs(found - turn)[:2].max() * CAMERA.fx < 0.5  # pixels
    assert abs(found - turn)[2] * 150.0 < 0.5


def test_a_shift_along_a_wall_is_the_turn_that_looks_like_it() -> None:
    before, now, looks = two_frames(np.zeros(3), 1)
    found = turn_between(CAMERA, corners(before + np.array([5.0, -3.0]), looks), corners(now, looks))
    assert found is not None
    moved = CAMERA.project(np.array([[0.0, 0.0, 1.0]]) @ so3_exp(found).T)[0] - (CAMERA.cx, CAMERA.cy)
    assert moved == pytest.approx([5.0, -3.0], abs=0.4)


def test_few_corners_say_nothing() -> None:
    before, now, looks = two_frames(np.array([0.0, 0.05, 0.0]), 2, LEAST_CORNERS)
    assert turn_between(CAMERA, corners(before, looks), corners(now, looks)) is not None
    assert turn_between(CAMERA, corners(before[1:], looks[1:]), corners(now, looks)) is None
    none = corners(np.zeros((0, 2)), np.zeros((0, 4), np.uint64))
    assert turn_between(CAMERA, none, none) is None


def test_corners_that_agree_on_nothing_say_nothing() -> None:
    _, now, looks = two_frames(np.zeros(3), 3)
    before = np.random.default_rng(4).uniform((0, 0), (640, 480), now.shape)
    assert turn_between(CAMERA, corners(before, looks), corners(now, looks)) is None


def test_corners_all_in_one_place_turn_nothing_about_it() -> None:
    _, now, looks = two_frames(np.zeros(3), 5, 40)
    here, there = np.full_like(now, 300.0), np.full_like(now, 304.0)
    found = turn_between(CAMERA, corners(there, looks), corners(here, looks))
    assert found is not None
    assert np.linalg.norm(found) == pytest.approx(np.hypot(4, 4) / CAMERA.fx, rel=0.02)
