"""The fisheye lens, against its own polynomial put to every angle."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.geometry.fisheye import WIDEST, folds_at, radius_of, theta_of

SOUND = [
    (),
    (-0.01, 0.0, 0.0, 0.0),
    (-0.0066, 0.0444, -0.0413, 0.0079),  # of the kind that tracking cameras have
    (0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202, 0.00020293673591811182),
]
FOLDING = [
    (-0.0135, -0.0335, 0.0419, -0.0189),
    (0.05, -0.12, 0.05, -0.02),
    (-0.02, -0.01, 0.0, -0.02),
    (0.1453, -0.004, 0.0069, -0.0595),  # Newton's steps alone leave it from well within
    (-0.5, 0.0, 0.0, 0.0),
]


@pytest.mark.parametrize("k", SOUND)
def test_a_sound_lens_does_not_fold_within_what_it_sees(k: tuple[float, ...]) -> None:
    assert folds_at(k) > WIDEST
    theta = np.linspace(0.0, WIDEST, 300)
    np.testing.assert_allclose(theta_of(radius_of(theta, k), k), theta, atol=1e-9)


@pytest.mark.parametrize("k", FOLDING)
def test_one_that_folds_is_undone_up_to_there_and_no_farther(k: tuple[float, ...]) -> None:
    theta = np.linspace(0.0, WIDEST, 200_000)
    first = theta[:-1][np.diff(radius_of(theta, k)) <= 0.0][0]
    assert folds_at(k) == pytest.approx(first, abs=2e-5)
    within = np.linspace(0.0, 0.99 * first, 300)
    np.testing.assert_allclose(theta_of(radius_of(within, k), k), within, atol=1e-7)
    beyond = radius_of(np.array([first]), k) + np.linspace(1e-3, 1.0, 5)
    np.testing.assert_allclose(theta_of(beyond, k), first, atol=1e-3)


@pytest.mark.parametrize(
    "k",
    [
        (0.08994273008610892, 0.21320706291176678, 0.2713951007445065, -0.11583430152951027),
        (0.2626845901057386, 0.2879854961562421, 0.22700267026055637, -0.18192311612953102),
        (0.2369935522884285, 0.18616485537784033, 0.1633076807973758, -0.12246864485676026),
    ],
)
def test_steps_that_go_to_and_fro_between_a_flat_and_a_steep_place_come_to_an_end(
    k: tuple[float, ...],
) -> None:
    theta = np.linspace(0.0, 0.98 * min(folds_at(k), WIDEST), 50)
    np.testing.assert_allclose(theta_of(radius_of(theta, k), k), theta, atol=1e-9)


@given(st.lists(st.floats(-0.3, 0.3), min_size=4, max_size=4))
def test_any_lens_is_undone_where_it_grows(k: list[float]) -> None:
    lens = tuple(k)
    theta = np.linspace(0.0, 0.98 * min(folds_at(lens), WIDEST), 50)
    back = theta_of(radius_of(theta, lens), lens)
    np.testing.assert_allclose(radius_of(back, lens), radius_of(theta, lens), atol=1e-9)
    assert np.all(np.diff(radius_of(theta, lens)) > 0.0)


def test_next_to_no_distortion_folds_nowhere() -> None:
    """A division by 5e-324 is infinite, of which there are no roots."""
    assert folds_at((0.0, 0.0, 0.0, 5e-324)) == np.inf
    assert folds_at((-0.4, 0.0, 5e-324, -5e-324)) == pytest.approx(np.sqrt(1.0 / 1.2))
