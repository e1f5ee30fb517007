"""What weighs in the least squares where the gate is shut, as by figures that are another network's."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from prism_edge.config import GateConfig, ScaleConfig
from prism_edge.scale.estimator import ScaleEstimator
from prism_edge.scale.sample_trust import LEAST_TRUST, SHUT, ShutGate, opened, sample_trust
from tests.scale.scene import SHAPE, depth_of, keyframe_of_wall

CONFIG = ScaleConfig(hold_sigmas=0.0)
PAPERS = {"dsug_tau": 0.07, "dsug_temperature": 0.02}


def play(confidence, count=100, metres_per_unit=1.3):
    """An estimator, and what it said of keyframes whose network has about one confidence everywhere."""
    estimator, said = ScaleEstimator(CONFIG, gate=GateConfig()), []
    rng = np.random.default_rng(0)
    for k in range(count):
        keyframe = keyframe_of_wall(k, k * 0.4, metres_per_unit, parallax_deg=3.0 if k else 0.0)
        shown = np.maximum(confidence * np.exp(rng.normal(0, 0.05, SHAPE)), 1.0).astype(np.float32)
        said.append(estimator.process(keyframe, depth_of(keyframe, confidence=shown, **PAPERS))[0])
    return estimator, said


@pytest.mark.parametrize("confidence", [1.05, 1.5, 2.0, 20.0])
def test_scale_is_learned_whatever_level_a_networks_confidence_has(confidence):
    _, said = play(confidence)
    assert said[-1].log_scale == pytest.approx(np.log(1.3), abs=0.05)
    assert said[-1].filter_sigma < said[0].filter_sigma / 2


def test_a_gate_that_is_shut_for_one_image_after_another_is_doubted():
    assert "fit_gate" in play(1.5, SHUT + 1)[0].doubt
    assert play(1.5, SHUT - 1)[0].doubt == ""
    assert play(20.0, 2 * SHUT)[0].doubt == ""
    estimator, _ = play(1.5, SHUT + 1)
    estimator.begin(1)
    assert estimator.doubt == ""


def test_one_image_that_is_let_through_ends_the_doubt():
    gate = ShutGate()
    for _ in range(SHUT):
        gate.see(np.full(5, 1e-6))
    assert gate.doubt
    gate.see(np.zeros(0))  # a keyframe without keypoints says nothing
    assert gate.doubt
    gate.see(np.full(5, 0.5))
    assert not gate.doubt


@given(arrays(np.float64, st.integers(0, 30), elements=st.floats(0.0, 1.0)))
def test_weights_are_raised_alike_up_to_one_and_never_lowered(weights):
    raised = opened(weights)
    assert np.all((weights <= raised) & (raised <= 1.0))
    order = np.argsort(weights, kind="stable")
    assert np.all(np.diff(raised[order]) >= 0.0)
    if len(weights) and np.median(weights) >= LEAST_TRUST:
        np.testing.assert_array_equal(raised, weights)


def test_half_of_an_image_weighs_a_twentieth_at_least():
    raised = opened(np.array([1e-9, 1e-8, 2e-8, 4e-8, 0.5]))
    np.testing.assert_allclose(raised, [0.0025, 0.025, 0.05, 0.1, 1.0])


def test_what_the_tracker_thinks_of_a_point_counts_beside_the_gate():
    keyframe = keyframe_of_wall(0, 0.0, points=4)
    told = replace(keyframe, trust=np.array([0.5, 0.25, 0.0, np.nan], np.float32))
    np.testing.assert_allclose(sample_trust(told, np.full(4, 0.8)), [0.8, 0.4, 0.04, 0.04], rtol=1e-6)
    np.testing.assert_allclose(sample_trust(keyframe, np.full(4, 0.8)), 0.8, rtol=1e-6)
