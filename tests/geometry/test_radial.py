"""A radial lens undone, against the polynomial itself."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from prism_edge.geometry.radial import undistort_radial


def seen(xy: np.ndarray, k1: float, k2: float, k3: float) -> np.ndarray:
    """Where the lens shows points of the plane z = 1."""
    t = np.sum(xy * xy, axis=1, keepdims=True)
    return xy * (1.0 + k1 * t + k2 * t**2 + k3 * t**3)


def rising(k1: float, k2: float, k3: float, radius: float) -> bool:
    """Whether the lens keeps the order of radii up to one."""
    t = np.linspace(0.0, radius, 200) ** 2
    return bool((1.0 + 3.0 * k1 * t + 5.0 * k2 * t**2 + 7.0 * k3 * t**3).min() > 0.02)


@settings(max_examples=200, deadline=None)
@given(
    k1=st.floats(-0.5, 0.5),
    k2=st.floats(-0.5, 0.5),
    k3=st.floats(-0.5, 0.5),
    x=st.floats(-0.8, 0.8),
    y=st.floats(-0.6, 0.6),
)
def test_what_the_lens_has_done_is_undone(k1: float, k2: float, k3: float, x: float, y: float) -> None:
    true = np.array([[x, y], [0.5 * x, -0.5 * y], [0.0, 0.0]])
    assume(rising(k1, k2, k3, float(np.hypot(x, y))))
    np.testing.assert_allclose(undistort_radial(seen(true, k1, k2, k3), k1, k2, k3), true, atol=1e-10)


@pytest.mark.parametrize("k", [(0.33, 0.08, -0.37), (0.4, 0.1, -0.45), (0.2, 0.1, -0.2), (0.6, -0.5, 0.0)])
def test_a_lens_that_stretches_before_it_folds_is_undone_to_its_fold(k: tuple[float, float, float]) -> None:
    """What is seen as far out as the fold lies well inside: steps that begin there begin where it is flat."""
    radii = np.linspace(0.0, 3.0, 300_001)
    fold = radii[np.argmin(np.diff(seen(np.column_stack([radii, 0.0 * radii]), *k)[:, 0]) > 0.0)]
    true = np.linspace(0.0, 0.99 * fold, 2000)[:, None] * (0.6, -0.8)
    assert np.linalg.norm(seen(true, *k), axis=1).max() > fold
    np.testing.assert_allclose(undistort_radial(seen(true, *k), *k), true, atol=1e-8)


@pytest.mark.parametrize("k1", [-0.1, -0.6, -2.0, -30.0])
def test_what_no_point_looks_like_is_put_on_the_fold(k1: float) -> None:
    fold = np.sqrt(1.0 / (-3.0 * k1))  # d/dr (r + k1 r^3) = 0
    farthest_seen = fold * 2.0 / 3.0
    beyond = np.array([[1.2, 0.0], [0.0, -5.0], [0.6, 0.8]]) * farthest_seen * 1.1
    found = undistort_radial(beyond, k1, 0.0, 0.0)
    np.testing.assert_allclose(np.hypot(*found.T), fold, rtol=1e-9)
    np.testing.assert_allclose(found / fold, beyond / np.hypot(*beyond.T)[:, None], atol=1e-9)


def test_no_points_are_none() -> None:
    assert undistort_radial(np.zeros((0, 2)), -0.1, 0.0, 0.0).shape == (0, 2)
