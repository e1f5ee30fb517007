import numpy as np
import pytest

from prism_edge.config import ScaleConfig
from prism_edge.scale.filter import ScaleFilter
from prism_edge.scale.least_squares import HUBER, Observation, plain_mean, weighted_least_squares

SIGMA, FRAME = 0.25, 0.15


def solve(values, patches=None, weights=None, min_points=3):
    values = np.asarray(values, dtype=np.float64)
    patches = np.arange(len(values)) if patches is None else np.asarray(patches)
    weights = np.ones(len(values)) if weights is None else np.asarray(weights)
    return weighted_least_squares(values, patches, weights, SIGMA, FRAME, min_points)


def test_without_outliers_it_is_the_weighted_mean():
    values = np.array([0.1, 0.2, 0.05, 0.15])
    weights = np.array([1.0, 0.5, 0.25, 1.0])
    assert solve(values, weights=weights).log_scale == pytest.approx(np.average(values, weights=weights))


def test_the_pixels_of_a_patch_count_once_together():
    values = np.array([0.0, 0.0, 0.0, 0.0, 0.2])
    result = solve(values, patches=[0, 0, 0, 0, 1])
    assert result.log_scale == pytest.approx(0.1)
    assert result.point_variance == pytest.approx(SIGMA**2 / 2)
    assert result.variance == pytest.approx(SIGMA**2 / 2 + FRAME**2)
    assert result.points == 5


def test_gate_weights_scale_the_information():
    values = np.full(40, 0.3)
    assert solve(values, weights=np.full(40, 0.25)).point_variance == pytest.approx(
        4 * solve(values).point_variance
    )


def test_a_keypoint_of_no_weight_is_not_there():
    result = solve([0.1, 0.1, 0.1, 9.0], weights=[1, 1, 1, 0])
    assert result.points == 3
    assert result.log_scale == pytest.approx(0.1)


def test_a_third_of_gross_outliers_hardly_matters_where_a_mean_is_lost():
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(0.1, 0.1, 200), rng.normal(2.5, 0.3, 100)])
    assert abs(solve(values).log_scale - 0.1) < 0.2
    assert abs(plain_mean(values, SIGMA, FRAME, 3).log_scale - 0.1) > 0.7


def test_the_log_scale_is_where_the_robust_cost_is_least():
    """A quarter of the points say otherwise; the cost on a fine grid says where its minimum is."""
    rng = np.random.default_rng(5)
    values = np.concatenate([rng.normal(0.1, 0.2, 60), rng.normal(1.5, 0.2, 20)])
    weights = rng.uniform(0.1, 1.0, len(values))
    grid = np.linspace(-0.5, 1.0, 15_001)
    off = np.abs(values - grid[:, None]) / SIGMA
    cost = np.where(off <= HUBER, 0.5 * off**2, HUBER * (off - 0.5 * HUBER)) @ weights
    assert solve(values, weights=weights).log_scale == pytest.approx(grid[cost.argmin()], abs=2e-4)


def test_the_variance_grows_where_residuals_exceed_sigma_0():
    values = np.random.default_rng(1).normal(0.0, 0.8, 200)
    assert solve(values).point_variance > 1.5 * SIGMA**2 / 200


def test_an_image_that_scatters_twice_as_much_is_trusted_half_as_far_in_its_scale():
    rng = np.random.default_rng(3)
    usual, wild = rng.normal(0.0, 0.2, 2000), rng.normal(0.0, 2 * SIGMA, 2000)
    assert solve(usual).variance == pytest.approx(FRAME**2, rel=0.01)
    assert solve(wild).variance == pytest.approx((2 * FRAME) ** 2, rel=0.1)


def test_the_variance_is_that_of_errors_shared_by_a_patch():
    rng = np.random.default_rng(2)
    errors, claimed = [], []
    for _ in range(300):
        patches = rng.integers(0, 30, 300)
        result = solve(rng.normal(0.0, SIGMA, 30)[patches] + rng.normal(0.0, 0.02, 300), patches)
        errors.append(result.log_scale)
        claimed.append(result.point_variance)
    assert 0.75 < np.mean(np.square(errors)) / np.mean(claimed) < 1.25


def test_too_few_points_say_nothing():
    assert solve([0.1, 0.2, 0.3], min_points=4) is None
    assert solve([0.1, np.nan, np.inf, 0.2], min_points=3) is None
    assert solve([], min_points=1) is None
    assert solve([1.0, 1.0, 1.0], weights=[0.0, 0.0, np.nan], min_points=1) is None
    assert plain_mean(np.array([0.1, np.nan]), SIGMA, FRAME, 2) is None


def test_the_ablation_is_the_plain_mean():
    values = np.array([0.0, 0.0, 0.3, 5.0])
    result = plain_mean(values, SIGMA, FRAME, 3)
    assert result.log_scale == pytest.approx(values.mean())
    assert result.variance == pytest.approx(SIGMA**2 / 4 + FRAME**2)


def test_what_an_image_scatters_beyond_the_usual_makes_the_filter_believe_it_less():
    known = {}
    for excess in (0.0, 0.3**2):
        scale = ScaleFilter(ScaleConfig())
        scale.fix_unit()
        scale.predict(0.0, 0.0)
        scale.predict(60.0, 0.0)  # what the first image shared with this one is over
        assert scale.update(Observation(0.2, 0.07**2 + 1e-4 + excess, 1e-4, 100, excess))
        known[excess] = scale
    calm, wild = known.values()
    assert 0.0 < wild.log_scale < 0.5 * calm.log_scale
    assert wild.sigma > 1.2 * calm.sigma
