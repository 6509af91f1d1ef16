"""Where data fall among predictions, and what is made of it, on numbers whose law is known."""

import numpy as np
import pytest
from scipy.stats import kstest, norm

from pymc_statespace_filters.diagnostics.calibration import (
    coverage_of,
    pit_of,
    residual_of,
    uniformity_of,
    whiteness_of,
)


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


def test_residuals_are_normal_quantiles_within_what_draws_can_tell():
    found = residual_of(np.array([1e-9, 0.2, np.nan, 1.0]), 100)
    np.testing.assert_allclose(found, [norm.ppf(0.005), norm.ppf(0.2), np.nan, norm.isf(0.005)])


def test_coverage_of_central_intervals():
    pit = np.column_stack([(np.arange(100) + 0.5) / 100, np.full(100, 0.2)])
    pit[:10, 1] = np.nan
    np.testing.assert_allclose(coverage_of(pit, 0.5), [0.5, 0.0])
    np.testing.assert_allclose(coverage_of(pit, 0.9), [0.9, 1.0])
    assert np.isnan(coverage_of(np.full((3, 1), np.nan), 0.5)).all()


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
