"""The effective number of a filter is that of the weights whose mean is the term."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.filters.outcomes import COLLAPSED
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.states import TermHealth
from pymc_statespace_filters.system.given_record import GivenRecord
from pymc_statespace_filters.system.parameters import flat_parameters
from pymc_statespace_filters.system.record import checked_record
from tests.references.records import PRECISE_DOUBLE_WELL, SURPRISES, double_well_with_surprises
from tests.systems import DOUBLE_WELL_SYSTEM, double_well_parameters

N = 200
PARAMETERS = double_well_parameters(PRECISE_DOUBLE_WELL)


def term_health(filter, observed, steps, seed=0):
    record = checked_record(DOUBLE_WELL_SYSTEM, GivenRecord(observed, steps=steps)).arguments
    theta = flat_parameters(DOUBLE_WELL_SYSTEM, PARAMETERS)
    return evaluator(TermHealth(DOUBLE_WELL_SYSTEM, filter))(theta, *record, np.asarray(seed))


@pytest.mark.parametrize("filter", [psf.BootstrapPF(N), psf.EnKF(N), psf.PFEnKF(N)])
def test_a_mean_over_forecast_members_has_the_number_of_their_densities(filter):
    """At step 0 all filters have the same members; the bootstrap filter shows their weights."""
    observed, steps = [0.2], [0]
    terms, n_effective, health = term_health(filter, observed, steps)
    run = psf.run_filter(DOUBLE_WELL_SYSTEM, psf.BootstrapPF(N), PARAMETERS, observed, steps=steps)
    weights = run["weights"].values[0]
    np.testing.assert_allclose(terms, run["log_likelihood"], rtol=1e-12)
    np.testing.assert_allclose(n_effective, 1 / np.sum(weights**2), rtol=1e-9)
    assert health[0] == n_effective.min()


def test_a_mean_over_updated_weights_has_their_number():
    observed, steps = [0.2, np.nan, 0.4], [0, 20, 40]
    filter = psf.PFEnKF(N, likelihood="weights")
    _, n_effective, health = term_health(filter, observed, steps)
    run = psf.run_filter(DOUBLE_WELL_SYSTEM, filter, PARAMETERS, observed, steps=steps)
    of_weights = 1 / np.sum(run["weights"].values ** 2, axis=1)
    np.testing.assert_allclose(n_effective[[0, 2]], of_weights[[0, 2]], rtol=1e-9)
    assert np.isnan(n_effective[1])  # no observation, no term
    assert health[0] == np.nanmin(n_effective)


def test_a_gaussian_likelihood_rests_on_all_members():
    filter = psf.EnKF(N, likelihood="gaussian")
    _, n_effective, _ = term_health(filter, [0.2, 9.0], [0, 20])
    assert (n_effective == N).all()


def test_no_surprise_is_passed_over():
    """Few particles are near a surprise; the updated weights of PFEnKF do not show it."""
    record = double_well_with_surprises()
    first = min(SURPRISES)
    observed, steps = record.observed[: first + 1], record.steps[: first + 1]
    for seed in range(6):
        _, n_effective, health = term_health(psf.PFEnKF(250), observed, steps, seed)
        assert n_effective[first] < COLLAPSED
        assert health[0] == n_effective.min()
