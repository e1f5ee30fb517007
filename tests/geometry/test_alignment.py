"""Alignment against a known transform, against scipy, and where it can't be determined."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from prism_edge.geometry.alignment import DegenerateAlignment, align

SEEDS = st.integers(0, 2**32 - 1)


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.floats(0.01, 100.0), st.integers(4, 40))
def test_recovers_a_known_similarity(seed: int, scale: float, n: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(rng=rng).as_matrix()
    translation = rng.normal(size=3) * 10
    source = rng.normal(size=(n, 3))
    target = scale * source @ rotation.T + translation
    fit = align(source, target, with_scale=True)
    np.testing.assert_allclose(fit.rotation, rotation, atol=1e-8)
    np.testing.assert_allclose(fit.translation, translation, atol=1e-7)
    assert fit.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(fit.apply(source), target, atol=1e-7)


@settings(max_examples=30, deadline=None)
@given(SEEDS)
def test_rigid_fit_agrees_with_scipy_on_noisy_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(12, 3)), rng.normal(size=(12, 3))
    fit = align(source, target, with_scale=False)
    expected, _ = Rotation.align_vectors(target - target.mean(0), source - source.mean(0))
    np.testing.assert_allclose(fit.rotation, expected.as_matrix(), atol=1e-7)
    assert fit.scale == 1.0


@settings(max_examples=30, deadline=None)
@given(SEEDS)
def test_of_a_mirror_image_the_scale_is_the_best_for_the_rotation(seed: int) -> None:
    """No reflection is made, so one axis of three counts against the other two."""
    source = np.random.default_rng(seed).normal(size=(20, 3))
    target = source * (1.0, 1.0, -1.0)
    fit = align(source, target, with_scale=True)
    turned = (source - source.mean(axis=0)) @ fit.rotation.T
    best = ((target - target.mean(axis=0)) * turned).sum() / (turned**2).sum()
    assert fit.scale == pytest.approx(best)
    assert np.linalg.det(fit.rotation) == pytest.approx(1.0)


def test_what_differs_by_rounding_alone_coincides() -> None:
    spot = 1e6 + np.random.default_rng(0).uniform(-1e-9, 1e-9, (9, 3))
    assert len(np.unique(spot)) > 1
    with pytest.raises(DegenerateAlignment):
        align(spot, np.random.default_rng(1).normal(size=(9, 3)), with_scale=True)


@settings(max_examples=30, deadline=None)
@given(SEEDS)
def test_no_nearby_similarity_is_better(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(8, 3)), rng.normal(size=(8, 3))
    fit = align(source, target, with_scale=True)

    def cost(rotation: np.ndarray, translation: np.ndarray, scale: float) -> float:
        return float(((scale * source @ rotation.T + translation - target) ** 2).sum())

    best = cost(fit.rotation, fit.translation, fit.scale)
    for _ in range(10):
        turn = Rotation.from_rotvec(rng.normal(size=3) * 0.01).as_matrix()
        other = cost(turn @ fit.rotation, fit.translation + rng.normal(size=3) * 0.01, fit.scale * 1.01)
        assert other >= best


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.booleans())
def test_a_weight_counts_like_so_many_rows(seed: int, with_scale: bool) -> None:
    rng = np.random.default_rng(seed)
    source, target, times = rng.normal(size=(9, 3)), rng.normal(size=(9, 3)), rng.integers(1, 5, 9)
    weighted = align(source, target, with_scale, weights=0.3 * times)
    repeated = align(np.repeat(source, times, axis=0), np.repeat(target, times, axis=0), with_scale)
    np.testing.assert_allclose(weighted.rotation, repeated.rotation, atol=1e-9)
    np.testing.assert_allclose(weighted.translation, repeated.translation, atol=1e-9)
    assert weighted.scale == pytest.approx(repeated.scale, rel=1e-9)


def test_mirrored_points_get_a_rotation_not_a_reflection() -> None:
    source = np.random.default_rng(1).normal(size=(20, 3))
    fit = align(source, source * (1, 1, -1), with_scale=True)
    assert np.linalg.det(fit.rotation) == pytest.approx(1.0)


def test_points_on_a_line_still_align() -> None:
    source = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    target = 2.0 * source @ Rotation.from_euler("z", 40, degrees=True).as_matrix().T + 1.0
    fit = align(source, target, with_scale=True)
    assert fit.scale == pytest.approx(2.0)
    np.testing.assert_allclose(fit.apply(source), target, atol=1e-9)


@pytest.mark.parametrize(
    ("source", "target", "reason"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), "at least 3"),
        (np.ones((5, 3)), np.random.default_rng(0).normal(size=(5, 3)), "coincide"),
        (np.random.default_rng(0).normal(size=(5, 3)), np.full((5, 3), 1e6), "coincide"),
        (np.full((5, 3), np.nan), np.ones((5, 3)), "finite"),
        (np.random.default_rng(0).normal(size=(5, 3)), np.full((5, 3), np.inf), "finite"),
    ],
)
def test_undetermined_alignments_are_refused(source: np.ndarray, target: np.ndarray, reason: str) -> None:
    with pytest.raises(DegenerateAlignment, match=reason):
        align(source, target, with_scale=True)


def test_unequal_sets_are_refused() -> None:
    with pytest.raises(ValueError, match="must both be"):
        align(np.zeros((4, 3)), np.zeros((5, 3)), with_scale=False)
