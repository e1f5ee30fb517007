"""The filter against batch least squares with the full covariance, Monte Carlo, and bad input."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.config import ScaleConfig
from prism_edge.scale.filter import REOPEN_AFTER, ScaleFilter
from prism_edge.scale.least_squares import Observation

STILL = ScaleConfig(drift_per_sqrt_m=0.0, drift_per_sqrt_s=0.0, frame_sigma=0.15, correlation_s=2.0)
WHITE = 0.002  # point variance


def seen(z, white=WHITE, config=STILL):
    return Observation(float(z), white + config.frame_sigma**2, white, 100)


def played(times, values, config=STILL, unit=True):
    scale = ScaleFilter(config)
    for k, (time, value) in enumerate(zip(times, values, strict=True)):
        scale.predict(time, 0.0)
        if unit and k == 0:
            scale.fix_unit()
        else:
            scale.update(seen(value, config=config))
    return scale


def shared_errors(times, config=STILL):
    """Covariance (n, n) of the frame errors at these times."""
    return config.frame_sigma**2 * np.exp(-np.abs(np.subtract.outer(times, times)) / config.correlation_s)


def test_it_is_batch_least_squares_over_all_keyframes_at_once():
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.1, 1.0, 30))
    values = rng.normal(0.1, 0.05, 30)
    values[0] = 0.0
    own = STILL.point_sigma**2 / STILL.min_points
    covariance = shared_errors(times) + np.diag([own] + [WHITE] * 29)
    information = np.linalg.inv(covariance)
    scale = played(times, values)
    assert scale.accepted == 29
    assert scale.log_scale == pytest.approx(information.sum(0) @ values / information.sum(), abs=1e-9)
    assert scale.sigma == pytest.approx(1 / np.sqrt(information.sum()), abs=1e-9)


def two_parts(sigma=0.0):
    """A filter of one part for 10 s, of another, whose unit is 1.3 of the first's, for 20 s after a pause.

    The first and the joined one, and what batch least squares needs: values in the first's unit, covariance.
    """
    rng, own = np.random.default_rng(3), STILL.point_sigma**2 / STILL.min_points
    times = np.arange(0.0, 10.0, 0.5), np.arange(30.0, 50.0, 0.5)
    values = [np.concatenate([[0.0], rng.normal(0.1 * k, 0.05, len(t) - 1)]) for k, t in enumerate(times)]
    home, part = (played(*seen_there) for seen_there in zip(times, values, strict=True))
    joined = home.joined(part, np.log(1.3), sigma)
    blocks = [shared_errors(t) + np.diag([own] + [WHITE] * (len(t) - 1)) for t in times]
    values[1] = values[1] - np.log(1.3)
    return home, joined, times, values, blocks


def test_two_parts_joined_are_batch_least_squares_over_both_and_what_comes_after():
    """The images of the two err independently; those that come after err as the newer part's last ones."""
    _, joined, times, values, blocks = two_parts()
    later = np.arange(50.5, 54.0, 0.5)
    shown = np.random.default_rng(4).normal(0.0, 0.05, len(later))
    for count in (0, len(later)):
        for time, value in zip(later[:count], shown, strict=False):
            joined.predict(time, 0.0)
            assert joined.update(seen(value))
        white = np.concatenate([np.diag(blocks[1]) - STILL.frame_sigma**2, np.full(count, WHITE)])
        second = shared_errors(np.concatenate([times[1], later[:count]])) + np.diag(white)
        information = [np.linalg.inv(block) for block in (blocks[0], second)]
        seen_then = [values[0], np.concatenate([values[1], shown[:count]])]
        total = sum(i.sum() for i in information)
        mean = sum(i.sum(0) @ z for i, z in zip(information, seen_then, strict=True)) / total
        assert joined.log_scale == pytest.approx(mean, abs=1e-9)
        assert joined.sigma == pytest.approx(total**-0.5, abs=1e-9)
    assert joined.accepted == 19 + 39 + 7


def test_a_part_whose_unit_is_hardly_known_adds_little():
    home, joined, *_ = two_parts(sigma=0.5)
    assert joined.sigma == pytest.approx((home.sigma**-2 + 1 / (0.5**2 + home.sigma**2)) ** -0.5, rel=0.01)
    assert joined.log_scale == pytest.approx(home.log_scale, abs=0.2 * home.sigma)


def test_joined_to_a_part_of_which_nothing_is_known_it_is_what_is_known():
    _, joined, times, values, _ = two_parts()
    part = played(times[1], values[1])
    fresh = ScaleFilter(STILL)
    assert fresh.joined(part, 0.2, 0.0).log_scale == pytest.approx(part.log_scale - 0.2)
    assert joined.joined(ScaleFilter(STILL), 0.2, 0.0) is joined
    before = part.log_scale, part.sigma, part.accepted
    again = fresh.joined(part, 0.2, 0.0)
    again.predict(60.0, 0.0)
    again.update(seen(0.4))
    assert (part.log_scale, part.sigma, part.accepted) == before  # a late image may still come to it


def test_independent_errors_average_as_white_noise():
    config = replace(STILL, correlation_s=0.0)
    scale = played(np.arange(50) * 0.3, np.full(50, 0.05), config, unit=False)
    information = 1 / config.initial_sigma**2 + 50 / (config.frame_sigma**2 + WHITE)
    assert scale.sigma == pytest.approx(information**-0.5)
    assert scale.log_scale == pytest.approx(0.05 * (1 - 1 / config.initial_sigma**2 / information))


def test_a_hundred_correlated_keyframes_are_worth_about_ten():
    times = np.arange(100) / 3
    sigma = played(times, np.zeros(100), unit=False).sigma
    assert 7 < (STILL.frame_sigma / sigma) ** 2 < 13


def test_a_new_unit_is_as_uncertain_as_the_depth_that_fixed_it():
    scale = ScaleFilter(STILL)
    assert scale.is_open
    assert scale.sigma == pytest.approx(STILL.initial_sigma)
    scale.predict(0.0, 0.0)
    scale.fix_unit()
    assert not scale.is_open
    assert scale.log_scale == 0.0
    assert STILL.frame_sigma < scale.sigma < 1.2 * STILL.frame_sigma


def test_what_is_seen_at_once_tells_nothing_about_the_unit():
    """The frame error that fixed the unit is still the same: the depth would only repeat itself."""
    scale = ScaleFilter(STILL)
    scale.predict(0.0, 0.0)
    scale.fix_unit()
    before = scale.sigma
    scale.predict(1e-6, 0.0)
    scale.update(seen(0.0, white=1e-6))
    assert scale.sigma == pytest.approx(STILL.frame_sigma, rel=0.01)
    assert scale.sigma <= before


def test_the_claimed_sigma_is_the_error_over_many_runs():
    rng = np.random.default_rng(1)
    for count, gap in ((2, 0.3), (10, 0.3), (60, 0.5)):
        times = np.arange(count) * gap
        root = np.linalg.cholesky(shared_errors(times) + 1e-12 * np.eye(count))
        normalised = []
        for _ in range(400):
            errors = root @ rng.normal(size=count)
            errors[0] += rng.normal(0, STILL.point_sigma / np.sqrt(STILL.min_points))
            errors[1:] += rng.normal(0, np.sqrt(WHITE), count - 1)
            truth = -errors[0]  # the unit is the first depth
            scale = played(times, truth + errors)
            normalised.append((scale.log_scale - truth) / scale.sigma)
        assert abs(np.mean(normalised)) < 0.2
        assert 0.8 < np.mean(np.square(normalised)) < 1.25


def test_a_constant_scale_is_approached_without_overshoot_and_then_kept():
    scale = ScaleFilter(ScaleConfig())
    estimates = []
    for k in range(200):
        scale.predict(k * 0.3, k * 0.05)
        scale.update(seen(0.12)) if k else scale.fix_unit()
        estimates.append(scale.log_scale)
    assert np.all(np.diff(estimates) > -1e-9)
    assert max(estimates) <= 0.12
    assert estimates[-1] == pytest.approx(0.12, abs=0.03)
    assert np.ptp(estimates[100:]) < 0.02


def test_distance_and_time_let_the_scale_drift():
    config = ScaleConfig()
    scale = played(np.arange(50) * 1.0, np.zeros(50), config)
    variance = scale.sigma**2
    scale.predict(49.0 + 4.0, 100.0)
    drift = config.drift_per_sqrt_m**2 * 100.0 * np.exp(scale.log_scale) + config.drift_per_sqrt_s**2 * 4.0
    assert scale.sigma**2 - variance == pytest.approx(drift)


@pytest.mark.parametrize(("resumed", "counts"), [(900.0, 100.0), (50.0, 950.0), (math.nan, 950.0)])
def test_way_before_it_is_resumed_is_none_of_its(resumed, counts):
    config = replace(STILL, drift_per_sqrt_m=0.01)
    scale = ScaleFilter(config)
    scale.take_over(0.0, 0.02)
    scale.predict(0.0, 50.0)
    scale.resume(resumed)
    scale.predict(1.0, 1000.0)
    assert scale.sigma == pytest.approx(math.sqrt(0.02**2 + 0.01**2 * counts))


@pytest.mark.parametrize("first", [(0.0, 0.0), (math.nan, 0.0), (0.0, math.inf)])
def test_what_lies_between_a_late_depth_and_the_newest_keyframe_is_added_once(first):
    config, sigmas = ScaleConfig(), []
    for late in ((), ((40.0, 12.0), (math.nan, math.nan))):
        scale = ScaleFilter(config)
        scale.predict(*first)
        scale.predict(0.0, 0.0)
        scale.fix_unit()
        for step in ((100.0, 30.0), *late, (101.0, 31.0)):
            scale.predict(*step)
        sigmas.append(scale.sigma)
    assert sigmas[0] == sigmas[1]


def test_a_clock_that_was_set_back_does_not_stop_the_filter_s():
    scale = ScaleFilter(ScaleConfig(drift_per_sqrt_s=0.1))
    for time_s in (1e6, 1e5):
        scale.predict(time_s, 0.0)
    before = scale.sigma
    scale.predict(1e5 + 10.0, 0.0)
    assert scale.sigma > before


def test_a_gross_outlier_changes_nothing():
    scale = played(np.arange(20) * 0.3, np.zeros(20))
    before = scale.log_scale, scale.sigma, scale.accepted
    assert not scale.update(seen(np.log(10.0)))
    assert (scale.log_scale, scale.sigma, scale.accepted) == before
    assert scale.update(seen(0.02))


def test_depth_ten_times_too_large_for_a_while_is_sat_out():
    scale = played(np.arange(100) * 0.3, np.zeros(100))
    for k in range(REOPEN_AFTER[1] - 1):
        scale.predict(30 + k * 0.3, 0.0)
        assert not scale.update(seen(np.log(10.0)))
    scale.predict(60.0, 0.0)
    assert scale.update(seen(0.0))
    assert abs(scale.log_scale) < 0.05


@pytest.mark.parametrize("support", [3, 12, 100])
def test_evidence_as_strong_as_the_belief_overturns_it(support):
    needed = int(np.clip(support, *REOPEN_AFTER))
    scale = played(np.arange(support) * 0.3, np.zeros(support), unit=False)
    answers = []
    for k in range(needed):
        scale.predict(40 + k * 0.3, 0.0)
        answers.append(scale.update(seen(np.log(10.0) + 0.01 * (-1) ** k)))
    assert answers == [False] * (needed - 1) + [True]
    assert scale.log_scale == pytest.approx(np.log(10.0), abs=0.1)
    assert 0.1 < scale.sigma < 0.3
    for k in range(10):
        scale.predict(60 + k * 3.0, 0.0)
        assert scale.update(seen(np.log(10.0)))


def test_keyframes_without_depth_between_two_observations_make_the_second_no_less_new():
    """How far images spread is learned by what of each is new: by the time since the last, whoever came."""
    weights = []
    for between in ((), (9.0,)):
        scale = played([0.0, 0.3], [0.0, 0.1])
        for time in (*between, 10.0):
            scale.predict(time, 0.0)
        assert scale.update(seen(0.1))
        weights.append(scale._spread.weight)
    assert weights[0] == pytest.approx(weights[1])
    scale.predict(10.3, 0.0)
    assert scale.update(seen(0.1))
    assert scale._spread.weight - weights[1] == pytest.approx(1.0 - np.exp(-0.3 / STILL.correlation_s))


def test_what_one_network_s_images_shared_and_how_lost_it_was_says_nothing_of_another_s():
    scale = ScaleFilter(STILL)
    scale.take_over(0.0, 0.05, lost_sigma=2.0)
    scale.predict(0.0, 0.0)
    assert scale.update(seen(0.3))
    assert scale.log_scale < 0.15, "most of it was that image's"
    lost = scale.lost_sigma
    assert lost > 1.0
    scale.meet_another(0.1, STILL.frame_sigma, STILL)
    assert scale.sigma > lost, "the unit is known no better for that"
    assert (scale.lost_sigma, scale.doubt) == (0.0, "")
    known = scale.log_scale
    assert scale.update(seen(known))
    assert scale.log_scale == pytest.approx(known)


def test_outliers_that_contradict_each_other_never_overturn():
    scale = played(np.arange(20) * 0.3, np.zeros(20))
    rng = np.random.default_rng(3)
    for k in range(60):
        scale.predict(10 + k * 0.3, 0.0)
        assert not scale.update(seen(rng.choice([-1, 1]) * rng.uniform(1.5, 4.0)))
    assert abs(scale.log_scale) < 0.05


def test_a_map_of_unknown_unit_takes_its_first_observation_however_far():
    scale = ScaleFilter(STILL)
    scale.predict(0.0, 0.0)
    assert scale.update(seen(2.0))
    assert scale.log_scale == pytest.approx(2.0, abs=0.05)


def test_the_ablation_takes_the_last_observation():
    scale = ScaleFilter(STILL, kalman=False)
    for k, z in enumerate((0.1, -0.3, 2.0)):
        scale.predict(k * 0.3, 0.0)
        assert scale.update(seen(z))
        assert scale.log_scale == z
        assert scale.accepted == k + 1
        assert scale.sigma == pytest.approx(np.sqrt(WHITE + STILL.frame_sigma**2))


@pytest.mark.parametrize("z", [np.nan, np.inf, -np.inf, 1e9])
@pytest.mark.parametrize("kalman", [True, False])
def test_what_is_no_number_is_refused(z, kalman):
    scale = ScaleFilter(STILL, kalman)
    scale.predict(0.0, 0.0)
    scale.fix_unit()
    assert not scale.update(seen(z))
    assert not scale.update(seen(0.0, white=np.nan))
    assert scale.log_scale == 0.0


ANY = st.floats(allow_nan=True, allow_infinity=True)


@given(
    st.lists(st.tuples(ANY, ANY, st.one_of(ANY, st.floats(-3, 3)), st.floats(0, 1)), max_size=40),
    st.sampled_from([0.0, 2.0]),
    st.sampled_from([0.0, 0.15]),
)
@settings(max_examples=80, deadline=None)
def test_no_stream_of_numbers_makes_it_other_than_finite(stream, correlation_s, frame_sigma):
    scale = ScaleFilter(ScaleConfig(correlation_s=correlation_s, frame_sigma=frame_sigma))
    for k, (time, travelled, z, white) in enumerate(stream):
        scale.predict(time, travelled)
        if k == 0:
            scale.fix_unit()
        scale.update(Observation(z, white, white, 20))
        assert np.isfinite([scale.log_scale, scale.sigma, scale.learned_sigma]).all()
        assert scale.sigma >= 0.0
        assert abs(scale.log_scale) < 1e3


def test_certainty_and_endless_steps_are_survived():
    scale = ScaleFilter(ScaleConfig(frame_sigma=0.0))
    for k in range(5):
        scale.predict(k * 1e300, k * 1e307)
        scale.update(Observation(0.0, 0.0, 0.0, 20))
        scale.update(Observation(0.0, 0.0, 0.0, 20))
        assert np.isfinite([scale.log_scale, scale.sigma]).all()


def test_outliers_between_good_observations_never_overturn():
    """However alike they are: what fits between them speaks against them."""
    scale = played(np.arange(20) * 0.3, np.zeros(20))
    for k in range(2 * REOPEN_AFTER[1]):
        scale.predict(10 + k * 0.3, 0.0)
        assert not scale.update(seen(np.log(10.0)))
        assert scale.update(seen(0.0))
    assert abs(scale.log_scale) < 0.05


def test_drift_goes_with_metres_whatever_the_map_s_unit_is():
    config = ScaleConfig()
    scale = ScaleFilter(config)
    scale.take_over(np.log(10.0), 0.01)
    scale.predict(0.0, 0.0)
    variance = scale.sigma**2
    scale.predict(0.0, 1.0)  # a unit is ten metres
    assert scale.sigma**2 - variance == pytest.approx(10.0 * config.drift_per_sqrt_m**2)


@pytest.mark.parametrize("off", [0.1, 0.3, 1.0])
def test_a_belief_that_falls_to_a_small_contradiction_is_open_however_small(off):
    """A sensor's images agree to 1 %: what contradicts it may be less than the prior's sigma, or as much."""
    sensor = replace(STILL, frame_sigma=0.01, initial_sigma=0.3)
    scale = ScaleFilter(sensor)
    answers = []
    for k, z in enumerate([0.0] * 20 + [off] * 20):
        scale.predict(0.3 * k, 0.0)
        answers.append(scale.update(seen(z, white=1e-6, config=sensor)))
    assert answers == [True] * 20 + [False] * 19 + [True]
    assert scale.log_scale == pytest.approx(off, abs=0.005)
    assert 0.005 < scale.sigma < 0.05


@pytest.mark.parametrize("years", [0.1, 56.0])
def test_a_clock_that_is_set_forward_makes_it_forget_little(years):
    config = ScaleConfig()
    scale = played(np.arange(200) * 0.4, np.full(200, 0.3), config)
    before, sigma = scale.log_scale, scale.sigma
    scale.predict(80.0 + years * 365.25 * 86400.0, 0.0)
    assert scale.sigma < math.hypot(sigma, 0.0301)  # an hour's walk
    scale.update(seen(-0.3, config=config))
    assert abs(scale.log_scale - before) < 0.05
