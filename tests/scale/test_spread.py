"""The learned spread against closed forms and Monte Carlo, and what of it is the map's."""

from __future__ import annotations

import math

import numpy as np
import pytest

from prism_edge.config import ScaleConfig
from prism_edge.scale.filter import ScaleFilter
from prism_edge.scale.least_squares import Observation
from prism_edge.scale.spread import MOST_WEIGHT, PRIOR_WEIGHT, FrameSpread, LocalScale

STEP_S, TIME_CONSTANT_S, WHITE = 0.3, 2.0, 1e-4
CONFIG = ScaleConfig(drift_per_sqrt_m=0.0, drift_per_sqrt_s=0.0, correlation_s=TIME_CONSTANT_S)


def test_before_anything_is_seen_it_is_the_prior():
    assert FrameSpread(0.07).sigma == pytest.approx(0.07)


def test_residuals_weigh_by_how_much_of_them_is_new():
    spread = FrameSpread(0.1)
    spread.take(0.2, 0.1, 1.0)
    spread.take(-0.3, 0.0, 0.5)
    spread.take(5.0, 1.0, 0.0)  # says nothing that was not known
    expected = (PRIOR_WEIGHT * 0.01 + 0.05 + 0.045) / (PRIOR_WEIGHT + 1.5)
    assert spread.sigma == pytest.approx(math.sqrt(expected))


def test_what_was_learned_in_a_day_is_forgotten_as_soon_as_that_of_some_minutes():
    later = []
    for draws in (300, 30_000):
        spread = FrameSpread(0.1)
        for _ in range(draws):
            spread.take(0.04, 0.0, 1.0)
        assert spread.sigma == pytest.approx(0.04, rel=0.02)
        for _ in range(100):
            spread.take(0.32, 0.0, 1.0)
        later.append(spread.sigma)
    assert later[1] == pytest.approx(later[0], rel=1e-3)
    assert later[1] > 0.25


def test_a_few_minutes_count_in_full():
    spread, draws = FrameSpread(0.1), int(MOST_WEIGHT - PRIOR_WEIGHT)
    values = np.linspace(0.0, 0.3, draws)
    for value in values:
        spread.take(value, 0.0, 1.0)
    expected = (PRIOR_WEIGHT * 0.01 + (values**2).sum()) / MOST_WEIGHT
    assert spread.sigma == pytest.approx(math.sqrt(expected))
    assert draws / 0.5 > 180.0, "seconds: there is half a draw in each at most, with correlation_s of 2"


def test_excess_is_what_a_sigma_of_doubt_leaves_of_it():
    spread = FrameSpread(0.1)
    assert spread.excess == 1.0
    for _ in range(96):
        spread.take(0.3, 0.0, 1.0)
    wide = math.sqrt((PRIOR_WEIGHT * 0.01 + 96 * 0.09) / 100.0)
    assert spread.excess == pytest.approx(wide / 0.1 * (1.0 - 1.0 / math.sqrt(200.0)))


def surely(spread: FrameSpread) -> float:
    return spread.sigma * (1.0 - 1.0 / math.sqrt(2.0 * spread.weight))


def test_metres_may_be_off_by_a_factor_where_neither_network_nor_map_explains_what_is_seen():
    spread, said = FrameSpread(0.1), []
    explained = math.hypot(0.1, 0.1)
    for _ in range(40):
        wide = surely(spread) / explained
        said.append(spread.lost_sigma)
        assert said[-1] == pytest.approx(min(max(20.0 * (wide - 1.0), 0.0), 2.0))
        assert bool(spread.doubt) == (wide > 1.0)
        spread.take(0.22, 0.0, 1.0)
    assert said[0] == 0.0
    assert said[-1] == 2.0
    assert any(0.0 < sigma < 2.0 for sigma in said)
    assert f"by {spread.sigma:.2f} (log) where 0.10 is usual" in spread.doubt


def test_a_steady_network_is_not_blamed_for_a_map_that_turned_on_the_spot():
    spread = FrameSpread(0.075)
    for _ in range(200):
        spread.take(0.12, 0.0, 1.0)
    assert spread.excess > 1.4
    assert spread.lost_sigma == 0.0
    assert spread.doubt == ""


@pytest.mark.parametrize("prior", [0.0, 0.02])
def test_what_a_map_wavers_by_is_not_held_against_a_sensor(prior):
    spread = FrameSpread(prior)
    for _ in range(200):
        spread.take(0.05, 0.0, 1.0)
    assert spread.excess == 1.0
    assert spread.doubt == ""


def test_a_network_as_thought_has_excess_by_rare_chance_alone():
    rng, found = np.random.default_rng(3), []
    for _ in range(400):
        spread = FrameSpread(0.15)
        for residual in rng.normal(0.0, 0.15, 12):
            spread.take(residual, 0.0, 1.0)
        found.append(spread.excess)
    assert 0.02 < np.mean(np.array(found) > 1.0) < 0.2
    assert np.mean(found) < 1.03


def observed(rng: np.random.Generator, spread: float, count: int) -> tuple[np.ndarray, float]:
    """What a network whose images err by ``spread``, alike in time, shows, and the true log scale."""
    phi = math.exp(-STEP_S / TIME_CONSTANT_S)
    errors = [rng.normal(0.0, spread)]
    for _ in range(count):
        errors.append(phi * errors[-1] + rng.normal(0.0, spread * math.sqrt(1.0 - phi * phi)))
    # The first depth is the map's unit: everything is seen relative to it.
    return np.array(errors[1:]) - errors[0] + rng.normal(0.0, math.sqrt(WHITE), count), -errors[0]


@pytest.mark.parametrize("spread", [0.05, 0.15, 0.3])
def test_the_learned_sigma_is_right_for_a_steadier_and_a_wilder_network(spread):
    rng = np.random.default_rng(3)
    card = 0.5 * (spread + 0.15)  # is half right
    squares, learned = [], []
    for _ in range(60):
        values, true = observed(rng, spread, 100)
        scale = ScaleFilter(CONFIG)
        scale.expect(card)
        scale.predict(0.0, 0.0)
        scale.fix_unit()
        for k, value in enumerate(values, 1):
            scale.predict(STEP_S * k, 0.0)
            scale.update(Observation(float(value), WHITE + 0.15**2, WHITE, 100))
        squares.append(((scale.log_scale - true) / scale.learned_sigma) ** 2)
        learned.append(0.15 * scale.learned_sigma / scale.sigma)
    # Thirty seconds hold about fifteen draws beside the card's four; without learning: 0.1, 1 and 4.
    assert 0.3 < np.mean(squares) < 1.8
    assert abs(np.log(np.mean(learned) / spread)) < max(0.6 * abs(np.log(card / spread)), 0.1)


def test_learning_changes_no_estimate():
    rng = np.random.default_rng(1)
    values, _ = observed(rng, 0.05, 40)
    estimates = []
    for expected in (0.01, 0.15, 1.0):
        scale = ScaleFilter(CONFIG)
        scale.expect(expected)
        scale.fix_unit()
        for k, value in enumerate(values, 1):
            scale.predict(STEP_S * k, 0.0)
            scale.update(Observation(float(value), WHITE + 0.15**2, WHITE, 100))
        estimates.append((scale.log_scale, scale.sigma))
    assert estimates[0] == estimates[1] == estimates[2]


def test_a_belief_that_falls_forgets_what_it_had_learned():
    scale = ScaleFilter(CONFIG)
    scale.expect(0.02)
    scale.fix_unit()
    for k in range(1, 60):
        scale.predict(STEP_S * k, 0.0)
        scale.update(Observation(0.0, WHITE + 0.15**2, WHITE, 100))
    steady = scale.learned_sigma / scale.sigma
    for k in range(60, 120):
        scale.predict(STEP_S * k, 0.0)
        scale.update(Observation(2.0, WHITE + 0.15**2, WHITE, 100))
    assert scale.log_scale == pytest.approx(2.0, abs=0.1)
    assert steady < 0.2
    assert scale.learned_sigma / scale.sigma > 2.0 * steady


def test_local_scale_is_what_the_network_does_not_explain():
    local = LocalScale()
    assert local.sigma(0.1) == 0.0
    for _ in range(5):
        local.take(0.3, 0.8)
    assert local.sigma(0.0) == pytest.approx(0.3)
    assert local.sigma(0.1) == pytest.approx(math.sqrt(0.09 - 0.02))
    assert local.sigma(0.3) == 0.0


def test_local_scale_fades():
    local = LocalScale()
    local.take(0.4, 0.0)
    local.take(0.0, 0.5)
    assert local.sigma(0.0) == pytest.approx(math.sqrt(0.5 * 0.16 / 1.5))
    local.take(1e6, 0.0)  # a network gone mad does not make a map that is off by more than it can be
    assert local.sigma(0.0) == 1.0
