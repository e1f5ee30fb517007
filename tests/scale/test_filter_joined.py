"""Two parts of a map joined in one belief: what the older's waiting costs, and what the belief rests on."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from prism_edge.config import ScaleConfig
from prism_edge.scale.filter import REOPEN_AFTER, ScaleFilter
from prism_edge.scale.least_squares import Observation

STILL = ScaleConfig(drift_per_sqrt_m=0.0, drift_per_sqrt_s=0.0, frame_sigma=0.15, correlation_s=2.0)
WHITE = 0.002  # point variance


def seen(z: float, config: ScaleConfig = STILL) -> Observation:
    return Observation(float(z), WHITE + config.frame_sigma**2, WHITE, 100)


def played(begins_s: float, count: int, z: float = 0.0, config: ScaleConfig = STILL) -> ScaleFilter:
    scale = ScaleFilter(config)
    for k in range(count):
        scale.predict(begins_s + 0.3 * k, 0.0)
        scale.update(seen(z, config))
    return scale


@pytest.mark.parametrize("home_waits", [True, False])
def test_what_was_known_longest_ago_has_walked_since(home_waits: bool) -> None:
    """Product of two Gaussians at the later time, the older one a random walk's 100 s wider."""
    config = replace(STILL, drift_per_sqrt_s=0.02)
    begins = (0.0, 103.0) if home_waits else (103.0, 0.0)
    home, part = played(begins[0], 11, 0.0, config), played(begins[1], 11, 0.1, config)
    joined = home.joined(part, 0.0, 0.0)
    first, last = (home, part) if home_waits else (part, home)
    variances = first.sigma**2 + 0.02**2 * 103.0, last.sigma**2
    weights = 1.0 / np.array(variances)
    assert joined.sigma == pytest.approx(weights.sum() ** -0.5, rel=1e-6)
    mean = weights @ [first.log_scale, last.log_scale] / weights.sum()
    assert joined.log_scale == pytest.approx(mean, abs=1e-6)


def test_a_joined_belief_falls_to_as_many_as_both_rest_on() -> None:
    joined = played(0.0, 10).joined(played(10.0, 12), 0.0, 0.0)
    answers = []
    for k in range(22):
        joined.predict(60.0 + 0.3 * k, 0.0)
        answers.append(joined.update(seen(math.log(10.0) + 0.01 * (-1) ** k)))
    assert answers == [False] * 21 + [True]


def test_what_contradicted_a_part_in_its_own_unit_is_none_against_the_joined() -> None:
    fewest = REOPEN_AFTER[0]
    home, part = played(0.0, 3), played(10.0, 2, math.log(1.2))
    for k in range(fewest - 1):
        part.predict(12.0 + 0.3 * k, 0.0)
        assert not part.update(seen(4.0))
    joined = home.joined(part, math.log(1.2), 0.0)
    joined.predict(14.0, 0.0)
    assert not joined.update(seen(4.0)), "the first of its kind in this unit"


def test_the_way_in_a_part_was_in_its_own_unit_and_is_none_of_the_joined() -> None:
    config = replace(STILL, drift_per_sqrt_m=0.02)
    home, part = played(0.0, 10, 0.0, config), played(10.0, 10, 0.0, config)
    home.predict(3.0, 50.0)
    part.predict(13.0, 5.0)
    joined = home.joined(part, 0.0, 0.0)
    before = joined.sigma
    joined.predict(13.0, 52.0)  # two metres on from where home was left
    assert joined.sigma**2 - before**2 == pytest.approx(0.02**2 * 2.0 * math.exp(joined.log_scale), rel=1e-6)


@pytest.mark.parametrize("told_to_home", [True, False])
def test_what_was_told_of_a_lost_network_stays_told(told_to_home: bool) -> None:
    told, other = ScaleFilter(STILL), played(10.0, 3)
    told.take_over(0.0, 0.02, lost_sigma=2.0)
    home, part = (told, other) if told_to_home else (other, told)
    known = max(home.lost_sigma, part.lost_sigma)
    assert known == pytest.approx(2.0)
    assert home.joined(part, 0.0, 0.0).lost_sigma > 0.5 * known


def test_after_a_belief_has_fallen_the_new_one_falls_to_a_few_again() -> None:
    """It rests on one observation, whatever the old one rested on."""
    scale = played(0.0, 30)
    for k in range(30):
        scale.predict(60.0 + 0.3 * k, 0.0)
        fallen = scale.update(seen(math.log(10.0)))
    assert fallen
    answers = []
    for k in range(REOPEN_AFTER[0]):
        scale.predict(120.0 + 0.3 * k, 0.0)
        answers.append(scale.update(seen(0.0)))
    assert answers == [False] * (REOPEN_AFTER[0] - 1) + [True]
