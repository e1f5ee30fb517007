"""The published scale moves only when the estimate contradicts it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.scale.steady import SteadyScale

ESTIMATES = st.lists(st.tuples(st.floats(-3, 3), st.floats(0.001, 1.0)), min_size=1, max_size=30)


def test_an_estimate_within_the_slack_moves_nothing():
    steady = SteadyScale(0.7)
    for estimate in (0.05, -0.06, 0.069):
        steady.follow(estimate, 0.1)
        assert steady.log_scale == 0.0


def test_a_contradiction_is_followed_to_the_edge_of_the_slack():
    steady = SteadyScale(0.7)
    steady.follow(0.5, 0.1)
    assert steady.log_scale == pytest.approx(0.43)
    steady.follow(-0.5, 0.1)
    assert steady.log_scale == pytest.approx(-0.43)


def test_metres_of_a_network_out_of_its_depth_are_held_the_more():
    steady = SteadyScale(0.7)
    steady.follow(0.5, 0.1, 2.0)
    assert steady.log_scale == pytest.approx(0.22)
    steady.follow(0.5, 0.1, 1.0)
    assert steady.log_scale == pytest.approx(0.43), "it has found its feet again"


def test_without_slack_the_estimate_itself_is_published():
    steady = SteadyScale(0.0)
    steady.follow(0.3, 0.1)
    assert steady.log_scale == 0.3


@given(ESTIMATES, st.floats(0.0, 2.0))
def test_what_is_held_is_never_farther_than_the_slack(estimates, sigmas):
    steady = SteadyScale(sigmas)
    for estimate, sigma in estimates:
        steady.follow(estimate, sigma)
        assert abs(estimate - steady.log_scale) <= sigmas * sigma + 1e-9


def test_a_steady_truth_is_reached_as_the_uncertainty_shrinks():
    steady = SteadyScale(0.7)
    for sigma in np.geomspace(0.3, 0.001, 40):
        steady.follow(0.2, float(sigma))
    assert steady.log_scale == pytest.approx(0.2, abs=0.001)
