"""A network's depth in the map's unit, against errors that are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.tracking.depth_alignment import (
    FAR_SHARE,
    FLAT,
    LEAST_SIGMA,
    MIN_ORDERED,
    DepthAlignment,
    _kernel,
    agreement,
    order,
)

SIZE = (640, 480)


@settings(max_examples=50, deadline=None)
@given(st.floats(0.2, 5.0), st.floats(0.0, 0.15), st.integers(0, 2**32 - 1))
def test_a_network_that_errs_by_a_factor_and_some_noise_is_informative(factor, noise, seed):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(1.0, 6.0, 200)
    agreed = agreement(truth, factor * truth * np.exp(rng.normal(0, noise, 200)))
    assert agreed.informative
    assert agreed.units_per_metre == pytest.approx(1.0 / factor, rel=0.06)


@pytest.mark.parametrize("network", ["constant", "inverted", "random"])
def test_a_network_that_does_not_tell_near_from_far_is_not(network):
    rng = np.random.default_rng(0)
    truth = rng.uniform(2.0, 40.0, 300)
    says = {"constant": np.full(300, 2.0), "inverted": 50.0 / truth, "random": rng.uniform(1, 3, 300)}
    assert not agreement(truth, says[network]).informative


def test_a_wall_of_one_depth_says_nothing_against_a_network():
    truth = np.random.default_rng(0).uniform(2.9, 3.1, 100)
    assert agreement(truth, np.full(100, 2.5)).informative


def room(error, count=250, seed=0):
    """Pixels, true depths and a network's, which errs by ``error`` (of pixels, in the log)."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((0, 0), SIZE, (count, 2))
    truth = rng.uniform(1.0, 6.0, count)
    return pixels, truth, truth * np.exp(-error(pixels))


def halves(pixels):
    """The left half of the image 30 % too near, the right half 30 % too far."""
    return np.where(pixels[:, 0] < 320, 0.3, -0.3)


def test_where_points_are_near_their_ratio_holds():
    pixels, truth, network = room(halves)
    alignment = DepthAlignment.of(pixels, truth, network, SIZE)
    asked = np.array([[100.0, 200.0], [250.0, 100.0], [400.0, 300.0], [600.0, 400.0]])
    units, sigma = alignment.at(asked)
    assert np.log(units) == pytest.approx([0.3, 0.3, -0.3, -0.3], abs=0.12)
    assert (sigma < 0.12).all()
    assert alignment.far_sigma > 0.25


def test_far_from_all_points_the_median_and_its_spread_hold():
    pixels, truth, network = room(halves)
    near = pixels[:, 0] < 200
    near |= (pixels[:, 0] > 320) & (pixels[:, 0] < 400)
    alignment = DepthAlignment.of(pixels[near], truth[near], network[near], SIZE)
    units, sigma = alignment.at(np.array([[639.0, 240.0]]))
    assert units == pytest.approx(alignment.overall.units_per_metre, rel=0.02)
    assert sigma == pytest.approx(alignment.far_sigma, rel=0.05)


def test_a_single_wrong_point_does_not_pull_its_surroundings_along():
    noise = np.random.default_rng(1).normal(0, 0.05, 250)
    pixels, truth, network = room(lambda _: noise)
    network[0] /= 20.0
    alignment = DepthAlignment.of(pixels, truth, network, SIZE)
    units, _ = alignment.at(pixels[:1])
    assert abs(np.log(units[0])) < 0.15


@settings(max_examples=30)
@given(st.floats(0.0, 0.4), st.floats(20.0, 200.0), st.floats(0.0, 6.28), st.integers(0, 1000))
def test_never_worse_than_one_ratio_and_sigma_says_how_good(size, wavelength, phase, seed):
    """Errors that vary smoothly over the image, from finer than the points' distance to coarser."""
    def error(pixels):
        return size * np.sin(pixels[:, 0] / wavelength + phase) * np.cos(pixels[:, 1] / wavelength)

    pixels, truth, network = room(error, 400, seed)
    known, asked = slice(0, 250), slice(250, 400)
    alignment = DepthAlignment.of(pixels[known], truth[known], network[known], SIZE)
    units, sigma = alignment.at(pixels[asked])
    left = np.log(truth[asked] / network[asked] / units)
    alone = np.log(truth[asked] / network[asked] / alignment.overall.units_per_metre)
    assert np.sqrt(np.mean(left**2)) <= 1.05 * np.sqrt(np.mean(alone**2)) + 1e-9
    assert np.mean((left / sigma) ** 2) < 3.0
    assert (sigma >= LEAST_SIGMA).all()


def test_the_unit_is_that_of_the_map():
    pixels, truth, network = room(halves)
    ours, _ = DepthAlignment.of(pixels, truth, network, SIZE).at(pixels)
    twice, _ = DepthAlignment.of(pixels, 2.0 * truth, network, SIZE).at(pixels)
    assert twice == pytest.approx(2.0 * ours)


@pytest.mark.parametrize("sigma", [0.1, 0.3])
def test_a_point_does_not_vouch_for_itself(sigma):
    """Where each errs by itself the others tell nothing of it: no less is left than there was."""
    noise = np.random.default_rng(3).normal(0, sigma, 250)
    alignment = DepthAlignment.of(*room(lambda _: noise), SIZE)
    assert alignment.local_sigma >= alignment.far_sigma
    assert alignment.far_sigma == pytest.approx(sigma, rel=0.15)


def test_a_point_s_weight_is_a_bell_as_wide_as_its_reach_and_a_tail_sqrt_8_times_as_wide():
    reach, away = 25.0, np.array([0.0, 10.0, 25.0, 60.0, 100.0])
    at = np.column_stack([300.0 + 0.6 * away, 200.0 - 0.8 * away])
    near, far = (np.exp(-(away**2) / (2.0 * width**2)) for width in (reach, np.sqrt(8.0) * reach))
    weights = _kernel(at, np.array([[300.0, 200.0]]), reach)
    assert weights[:, 0] == pytest.approx(near + FAR_SHARE * far, rel=1e-4)


def scattered(count: int = MIN_ORDERED, sigma: float = 0.5, seed: int = 0) -> np.ndarray:
    return np.exp(sigma * np.random.default_rng(seed).normal(size=count))


@given(st.floats(0.3, 3.0), st.floats(0.01, 100.0), st.integers(0, 1000))
def test_an_order_knows_no_size_and_no_flattening(flattened, size, seed):
    of_map = scattered(seed=seed)
    assert order(of_map, size * of_map**flattened) == pytest.approx(1.0)
    assert order(of_map, size * of_map**-flattened) == pytest.approx(-1.0)


def test_what_has_nothing_to_do_with_each_other_has_no_order():
    assert abs(order(scattered(2000, seed=1), scattered(2000, seed=2))) < 0.06


def test_few_points_and_walls_seen_from_the_front_have_no_order():
    many = scattered()
    assert order(many[1:], many[1:]) is None
    wall = np.exp(np.log(many) * 0.98 * FLAT / np.log(many).std())
    assert order(many, wall) is order(wall, many) is None
    assert order(many, wall ** (1.1 / 0.98)) == pytest.approx(1.0)
