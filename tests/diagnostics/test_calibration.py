"""Where data fall among predictions, and what is made of it, on numbers whose law is known."""

import numpy as np
import pytest
from scipy.stats import kstest, norm

from pymc_statespace_filters.diagnostics.calibration import (
    coverage_of,
    residual_limit,
    uniformity_of,
    whiteness_of,
)
from pymc_statespace_filters.diagnostics.predictions import (
    Laws,
    calibration_by_rank,
    calibration_of,
)
from pymc_statespace_filters.statistics.pit import pit_of

RNG = np.random.default_rng(0)


def test_the_place_of_a_datum_among_draws():
    draws = np.arange(9.0)[:, None]
    for datum, n_below in ((-1.0, 0), (3.5, 4), (10.0, 9)):
        pit = pit_of(np.array([datum]), draws, np.random.default_rng(1))
        assert n_below / 10 <= pit[0] <= (n_below + 1) / 10


@pytest.mark.parametrize("law", ["standard_normal", "standard_cauchy", "poisson"])
def test_it_is_uniform_if_the_datum_is_one_of_the_draws(law):
    """One seed in a thousand fails a right implementation; few draws, as rounding shows then."""
    rng = np.random.default_rng(2)
    numbers = getattr(rng, law)(size=(10, 4000)).astype(float)
    pit = pit_of(numbers[0], numbers[1:], rng)
    assert kstest(pit, "uniform").pvalue > 1e-3


def test_a_missing_datum_has_none_and_failed_draws_do_not_count():
    draws = np.array([[0.0, 0.0, np.nan], [1.0, np.nan, np.nan], [2.0, np.nan, np.nan]])
    pit = pit_of(np.array([np.nan, 0.5, 0.5]), draws, np.random.default_rng(3))
    assert np.isnan(pit[0])
    assert 0.5 <= pit[1] <= 1.0
    assert np.isnan(pit[2])


def test_a_censored_count_of_the_law_of_the_draws_is_uniform_and_has_no_residual():
    """Values are recorded as 2 where they are at most 2, and as 4 where at least 4."""
    rng = np.random.default_rng(4)
    numbers = rng.poisson(3.0, (20, 4000, 1)).astype(float)
    true = numbers[0]
    flags = np.where(true <= 2, -1, np.where(true >= 4, 1, 0))
    found = calibration_by_rank(numbers[1:], np.clip(true, 2, 4), rng, flags)
    assert kstest(found.pit[:, 0], "uniform").pvalue > 1e-3
    np.testing.assert_array_equal(np.isnan(found.residual), flags != 0)
    assert not found.clipped[flags != 0].any()


def test_the_transform_of_a_censored_value_is_drawn_from_its_interval():
    mean, cov = np.zeros((1, 3000, 1)), np.ones((1, 3000, 1, 1))
    limits = np.full((3000, 1), 0.4)
    flags = np.resize([-1, 1, 0], (3000, 1))
    z = limits - mean
    laws = Laws(mean, cov, norm.logcdf(z), norm.logsf(z), True)
    found = calibration_of(laws, limits, RNG, flags)
    at = norm.cdf(0.4)
    for flag, low, width in ((-1, 0.0, at), (1, at, 1.0 - at)):
        assert kstest(found.pit[flags == flag], "uniform", (low, width)).pvalue > 1e-3
    np.testing.assert_allclose(found.pit[flags == 0], at)
    np.testing.assert_array_equal(np.isnan(found.residual), flags != 0)


def test_residuals_by_rank_are_normal_quantiles_within_what_draws_can_tell():
    draws = np.arange(100.0)[:, None, None] * np.ones((4, 1))
    observed = np.array([[-1.0], [49.5], [np.nan], [200.0]])
    found = calibration_by_rank(draws, observed, np.random.default_rng(7))
    limit = residual_limit(100)
    assert limit == norm.isf(0.005)
    expected = np.clip(norm.ppf(found.pit), -limit, limit)
    np.testing.assert_allclose(found.residual, expected, atol=1e-12)
    np.testing.assert_array_equal(found.clipped, np.abs(expected) == limit)
    assert not found.clipped[1:3].any()
    # The innovation is not limited: 150.5 beyond the mean of the draws.
    np.testing.assert_allclose(observed[3] - found.mean[3], 150.5)


def test_the_mixture_over_draws_has_its_own_tails_and_moments():
    means, sd = np.array([-1.0, 1.0, np.nan]), 0.5
    observed = np.array([[0.3], [-4.0], [np.nan]])
    mean = np.broadcast_to(means[:, None, None], (3, 3, 1))
    cov = np.full((3, 3, 1, 1), sd**2)
    z = (observed - mean) / sd
    found = calibration_of(Laws(mean, cov, norm.logcdf(z), norm.logsf(z), True), observed, RNG)
    pit = norm.cdf((observed[:2] - means[:2]) / sd).mean(axis=1)
    np.testing.assert_allclose(found.pit[:2, 0], pit)
    np.testing.assert_allclose(found.residual[:2, 0], norm.ppf(pit))
    assert np.isnan(found.pit[2])
    np.testing.assert_allclose(found.mean, 0.0)
    np.testing.assert_allclose(found.cov, sd**2 + 1.0)
    assert not found.clipped.any()


def test_a_tail_that_one_draw_decides_is_cut_off():
    """Precise noise around 200 drawn states: six deviations out, no draw is near."""
    states = norm.ppf((np.arange(200) + 0.5) / 200)[:, None, None] * np.ones((3, 1))
    observed, noise = np.array([[0.4], [6.0], [-6.0]]), 0.1
    z = (observed - states) / noise
    laws = Laws(
        states, np.full((200, 3, 1, 1), noise**2), norm.logcdf(z), norm.logsf(z), known=False
    )
    found = calibration_of(laws, observed, RNG)
    np.testing.assert_array_equal(found.clipped[:, 0], [False, True, True])
    np.testing.assert_allclose(found.residual[1:, 0], residual_limit(200) * np.array([1, -1]))
    assert found.residual[0, 0] == pytest.approx(0.4, abs=0.01)
    sd = np.sqrt(found.cov[:, 0, 0])
    np.testing.assert_allclose((observed - found.mean)[1:, 0] / sd[1:], [6.0, -6.0], rtol=0.02)


def test_a_tail_is_known_by_the_effective_number_of_its_draws():
    """Five unequal draws are worth 4.2 of equal ones; with a smaller rest they are worth 2.2."""
    for rest, clipped in [(0.5, False), (0.15, True)]:
        tails = 1e-3 * np.array([1.0, rest, rest, rest, rest / 2.0])
        shape = (5, 1, 1)
        above = np.log(tails).reshape(shape)
        below = np.log1p(-tails).reshape(shape)
        laws = Laws(np.zeros(shape), np.ones((*shape, 1)), below, above, known=False)
        found = calibration_of(laws, np.zeros((1, 1)), RNG)
        expected = residual_limit(5) if clipped else norm.isf(tails.mean())
        assert found.residual.item() == pytest.approx(expected, rel=1e-9)
        assert found.clipped.item() == clipped


def test_moments_of_a_mixture_have_covariances():
    mean = np.array([[[1.0, -2.0]], [[-1.0, 2.0]], [[np.nan, 0.0]]])
    cov = np.broadcast_to([[0.5, 0.1], [0.1, 0.3]], (3, 1, 2, 2))
    tails = np.full((3, 1, 2), np.log(0.5))
    found = calibration_of(Laws(mean, cov, tails, tails, True), np.zeros((1, 2)), RNG)
    np.testing.assert_allclose(found.mean, [[0.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(found.cov, [[[1.5, -1.9], [-1.9, 4.3]]])


def test_coverage_of_central_intervals():
    pit = np.column_stack([(np.arange(100) + 0.5) / 100, np.full(100, 0.2)])
    pit[:10, 1] = np.nan
    np.testing.assert_allclose(coverage_of(pit, 0.5), [0.5, 0.0])
    np.testing.assert_allclose(coverage_of(pit, 0.9), [0.9, 1.0])
    assert np.isnan(coverage_of(np.full((3, 1), np.nan), 0.5)).all()


def test_whiteness_is_the_test_of_ljung_and_box():
    """Ten residuals of alternating sign: two lags, Q = 120 (0.81 / 9 + 0.64 / 8) = 20.4."""
    residual = np.tile([1.0, -1.0], 5)
    assert whiteness_of(residual) == pytest.approx(np.exp(-10.2), rel=1e-12)


def test_white_noise_is_rejected_as_often_as_the_level_says():
    """5 % of 2000: within four standard deviations of the binomial law, and a little for Q's."""
    noise = np.random.default_rng(4).standard_normal((2000, 100))
    rejected = np.mean([whiteness_of(row) < 0.05 for row in noise])
    assert 0.03 < rejected < 0.075


def test_autocorrelation_at_one_late_lag_is_found():
    noise = np.random.default_rng(5).standard_normal(300)
    noise[7:] += 0.5 * noise[:-7]
    assert whiteness_of(noise) < 1e-4
    noise[::50] = np.nan
    assert np.isfinite(whiteness_of(noise))


def test_uniformity_is_rejected_where_predictions_are_too_wide():
    rng = np.random.default_rng(6)
    pit = norm.cdf(rng.standard_normal(200))
    pit[3] = np.nan
    assert uniformity_of(pit) > 1e-3
    assert uniformity_of(norm.cdf(0.5 * norm.ppf(pit))) < 1e-4


def test_nothing_is_said_of_too_few():
    assert np.isnan(whiteness_of(np.array([1.0, 2.0, np.nan])))
    assert np.isnan(whiteness_of(np.ones(50)))
    assert np.isnan(uniformity_of(np.array([0.3, np.nan])))
