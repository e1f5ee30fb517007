"""Joins with parts that were forgotten, maps that are gone on with, other networks, edges of what stands."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from prism_edge.config import ScaleConfig
from prism_edge.messages import HOME
from prism_edge.scale.estimator import ScaleEstimator
from prism_edge.scale.filter import ScaleFilter
from prism_edge.scale.gate import temporal_uncertainty
from prism_edge.scale.least_squares import Observation
from prism_edge.scale.spread import PRIOR_WEIGHT
from tests.scale.scene import CAMERA, keyframe_of_wall
from tests.scale.test_gate import WALL, looking, seen_at, view_of
from tests.scale.test_parts import play

STILL = ScaleConfig(drift_per_sqrt_m=0.0, drift_per_sqrt_s=0.0, frame_sigma=0.15, correlation_s=2.0)
WHITE = 1e-4


def seen(z: float, config: ScaleConfig = STILL) -> Observation:
    return Observation(z, WHITE + config.frame_sigma**2, WHITE, 100)


def test_what_was_published_of_a_part_is_so_in_the_unit_of_the_part_that_it_joins() -> None:
    """Nothing new was seen, so nothing published moves, though it is held away from the estimate."""
    estimator = ScaleEstimator(ScaleConfig(hold_sigmas=3.0))
    play(estimator, [0], unit=2.0, valid=False)  # home, of which nothing is known: it is forgotten
    there = play(estimator, range(30, 90), part=30, unit=1.5)[-1]
    joined, units = np.array([[30, HOME]]), np.array([[-math.log(2.0), 0.001]])
    keyframe = replace(keyframe_of_wall(90, 36.0, 3.0), joined=joined, joined_units=units)
    estimator.hear(keyframe)
    back, _ = estimator.process(keyframe, None)
    assert back.log_scale == pytest.approx(there.log_scale + math.log(2.0), abs=1e-9)


def test_a_map_that_is_gone_on_with_is_built_by_the_unit_that_it_had() -> None:
    estimator = ScaleEstimator(ScaleConfig())
    estimator.take_over(0, math.log(1.5), 0.5, bias_sigma=0.1)
    (first,) = play(estimator, [90], unit=1.5, valid=False)
    assert (first.log_scale, first.map_log_scale) == pytest.approx((math.log(1.5),) * 2, abs=1e-12)


def test_what_the_images_of_one_network_shared_is_not_the_next_one_s() -> None:
    """Its first image, of what the estimate has, is no news."""
    scale = ScaleFilter(STILL)
    for k in range(20):
        scale.predict(3.0 * k, 0.0)
        scale.update(seen(0.0))
    for k in range(3):  # images of one moment that are off together
        scale.predict(60.0 + 0.1 * k, 0.0)
        scale.update(seen(0.25))
    assert scale._state[1] > 0.1
    scale.meet_another(0.14, 0.15, STILL)
    scale.predict(60.4, 0.0)
    known = scale.log_scale
    assert scale.update(seen(known))
    assert scale.log_scale == pytest.approx(known, abs=1e-9)


def test_images_that_come_one_after_the_other_teach_little_of_the_spread() -> None:
    scale = ScaleFilter(STILL)
    for k in range(101):
        scale.predict(0.1 * k, 0.0)
        scale.update(seen(0.0))
    new = 1.0 - math.exp(-0.1 / STILL.correlation_s)
    assert scale._spread.weight == pytest.approx(PRIOR_WEIGHT + 100 * new, rel=1e-6)


def test_a_sensor_s_word_on_its_spread_stands_where_a_belief_has_fallen() -> None:
    """As wide as that of a network it would not be believed for minutes."""
    config = replace(STILL, frame_sigma=0.01)
    scale = ScaleFilter(STILL)
    scale.assume(config)
    for k in range(10):
        scale.predict(3.0 * k, 0.0)
        scale.update(seen(0.0, config))
    for k in range(10):
        scale.predict(60.0 + 3.0 * k, 0.0)
        fallen = scale.update(seen(1.0, config))
    assert fallen
    assert scale._spread.sigma < 0.02


def test_beside_the_edge_of_what_stands_still_nothing_is_uncertain_and_all_is_known() -> None:
    """A depth pixel off at an edge is no discrepancy, and hides nothing."""
    thing = (-0.2, 0.2)  # hides the wall to 0.4 m from the first place, to 0.38 m from the second
    before, now = view_of(looking(0.0), thing=thing), view_of(looking(0.02), thing=thing)
    beside = np.array([[0.412, y, WALL] for y in np.linspace(-0.3, 0.3, 9)])
    found = temporal_uncertainty(now, [before], seen_at(CAMERA, now.world_from_camera, beside), 0.2)
    assert found == pytest.approx(np.zeros(9), abs=0.02)
