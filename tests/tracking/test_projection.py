"""Pixels of points against the camera model, levels against the pyramid's own scales."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.geometry.cameras import FISHEYE, Camera
from prism_edge.geometry.poses import inverse, se3_exp, transform
from prism_edge.tracking.point_table import PointTable
from prism_edge.tracking.projection import expected_octaves, project
from tests.tracking.cloud import CAMERA, FACTORS

LEVELS = len(FACTORS)


@given(
    st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6),
    st.lists(st.tuples(*[st.floats(-8.0, 8.0)] * 3), min_size=1, max_size=8),
)
def test_pixels_are_the_cameras(twist: list[float], places: list[tuple[float, float, float]]) -> None:
    pose, points = se3_exp(np.array(twist)), np.array(places)
    pixels, inside = project(CAMERA, pose, points)
    local = transform(inverse(pose), points)
    front = local[:, 2] > 1e-3
    expected = CAMERA.project(local[front])
    assert pixels[front] == pytest.approx(expected, rel=1e-9, abs=1e-6)
    seen = np.all((expected >= 0) & (expected < (CAMERA.width, CAMERA.height)), axis=1)
    at_the_border = np.abs(expected - np.clip(expected, 0, (CAMERA.width, CAMERA.height))).max(axis=1) < 1e-6
    assert np.array_equal(inside[front][~at_the_border | seen], seen[~at_the_border | seen])
    assert not inside[~front].any()


def test_a_wide_lens_sees_beyond_what_a_pinhole_would() -> None:
    wide = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, FISHEYE, (-0.01, 0.0, 0.0, 0.0))
    raw = np.array([[20.0, 240.0], [320.0, 470.0], [600.0, 60.0], [320.0, 240.0]])
    points = 3.0 * np.column_stack([wide.normalise(raw), np.ones(4)])
    pixels, inside = project(wide, np.eye(4), points)
    assert inside.all()
    assert np.any((pixels < 0) | (pixels >= (640, 480)), axis=1).sum() == 3


@given(st.integers(0, LEVELS - 1), st.integers(-4, 4), st.floats(0.5, 20.0))
def test_a_camera_that_is_as_much_nearer_as_levels_are_apart_sees_it_on_a_higher_one(
    octave: int, steps: int, distance: float
) -> None:
    table = PointTable()
    table.add(2, octave=[octave, 0], distance=[distance, 1.0])
    nearer = distance / FACTORS[1] ** steps
    assert expected_octaves(table, np.array([0]), np.array([nearer]), FACTORS).tolist() == [octave + steps]


def test_a_pyramid_of_one_level_takes_a_factor_of_e_for_the_next() -> None:
    """Then nothing is looked for where it would look quite different."""
    table = PointTable()
    table.add(2, octave=0, distance=1.0)
    levels = expected_octaves(table, np.arange(2), np.array([0.7, 0.3]), np.ones(1))
    assert levels.tolist() == [0.0, 1.0]
