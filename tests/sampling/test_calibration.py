"""Chains of every kind are calibrated, and the same comparisons find chains that are not.

All comparisons of a right sampler together fail for one set of seeds in a thousand. What they gave
is kept in ``docs/reference/calibration.md``, which ``python -m tests.sampling.calibration_report``
writes.
"""

from itertools import product

import numpy as np
import pytest
from scipy.stats import binom

import pymc_statespace_filters as psf
from tests.sampling.calibration import (
    CONTROLS,
    LENGTHS,
    SETTINGS,
    TUNE,
    Replications,
    calibrate,
    p_values,
)
from tests.sampling.rank_uniformity import chi_square_p, ecdf_band, ecdf_counts, ecdf_p, histogram

# By two statistics, for every quantity in every setting.
THRESHOLD = 0.001 / sum(2 * len(s.problem.quantities) for s in SETTINGS.values())

FOUND = 0.001  # of a sampler that is wrong, by the most telling of all its tests


@pytest.mark.slow
@pytest.mark.parametrize("name", SETTINGS)
def test_ranks_are_uniform(name):
    found = calibrate(SETTINGS[name])
    assert p_values(found.ranks).min() > THRESHOLD
    assert found.lags.mean(axis=0).max() < 0.1  # so that the law of the ranks is the uniform one


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLS)
def test_the_same_comparisons_find(name):
    assert p_values(calibrate(CONTROLS[name]).ranks).min() < FOUND


QUICK, *OTHERS = SETTINGS  # that the calibration runs at all is also tested without it


@pytest.mark.parametrize(
    "name", [QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)]
)
def test_replications_are_what_sample_dram_draws(name):
    replications = Replications(SETTINGS[name])
    for index in range(2 if name == QUICK else 5):
        draws = replications.chain(index, LENGTHS[0])
        replications.record.set_value(replications.truth_and_record(index)[1])
        tree = psf.sample_dram(
            LENGTHS[0],
            tune=TUNE,
            chains=1,
            model=replications.model,
            random_seed=index,
            progressbar=False,
            kernel=replications.kernel,
            compute_convergence_checks=False,
        )
        for variable, values in draws.items():
            np.testing.assert_array_equal(tree["posterior"][variable][0], values)


# The tests of uniform ranks, against enumeration and simulation.


def worst_tail(ranks, n_ranks):
    counts, n = ecdf_counts(np.array(ranks), n_ranks), len(ranks)
    places = np.arange(1, n_ranks) / n_ranks
    return np.minimum(binom.cdf(counts, n, places), binom.sf(counts - 1, n, places)).min()


@pytest.mark.parametrize(("n", "n_ranks"), [(3, 4), (5, 3), (4, 5)])
def test_the_p_value_of_an_ecdf_is_exact(n, n_ranks):
    outcomes = list(product(range(n_ranks), repeat=n))
    worst = np.array([worst_tail(ranks, n_ranks) for ranks in outcomes])
    for ranks, own in zip(outcomes[::7], worst[::7], strict=True):
        exact = np.mean(worst <= own * (1.0 + 1e-9))
        np.testing.assert_allclose(ecdf_p(np.array(ranks), n_ranks), exact, atol=1e-12)


def test_band_and_p_value_agree():
    rng = np.random.default_rng(1)
    low, high = ecdf_band(100, 20, error_rate=0.2)
    for ranks in rng.integers(20, size=(200, 100)):
        counts = ecdf_counts(ranks, 20)
        inside = np.all((counts >= low) & (counts <= high))
        # The law is discrete: the band's own rate is at most the one asked for.
        assert inside or ecdf_p(ranks, 20) <= 0.2


@pytest.mark.parametrize("p_value", [lambda r: chi_square_p(r, 64, 16), lambda r: ecdf_p(r, 64)])
def test_error_rates_are_those_stated(p_value):
    """Four standard errors on either side: one false alarm in 8000 seeds."""
    rng, rate, n_sets = np.random.default_rng(2), 0.1, 500
    found = np.mean([p_value(ranks) <= rate for ranks in rng.integers(64, size=(n_sets, 320))])
    assert abs(found - rate) < 4.0 * np.sqrt(rate * (1.0 - rate) / n_sets)


def test_bins_hold_equally_many_ranks():
    np.testing.assert_array_equal(histogram(np.arange(64), 64, 16), np.full(16, 4))
    with pytest.raises(ValueError, match="5 bins of one width cannot hold 64 ranks"):
        histogram(np.arange(64), 64, 5)
