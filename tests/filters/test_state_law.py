"""Draws of the state that a filter leaves have the moments that the filter reports."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.filters.state_law import exact_states, law_of_parts
from tests.filters.test_truth_regimes import INPUTS, OBSERVED, PARAMS, STEPS, SYSTEM
from tests.systems import FREE, PAIR, PAIR_DATA
from tests.systems import STEPS as PAIR_STEPS

M, N = 5000, 400
PAIRED = PAIR, {"a": 0.5, "b": 0.2}, PAIR_DATA, {"steps": PAIR_STEPS}
SWITCHING = SYSTEM, PARAMS, OBSERVED, {"steps": STEPS, "inputs": INPUTS}
ONE = FREE, {"a": 0.9}, [0.3, 1.2], {"steps": [0, 3]}
CASES = [
    (psf.EKF(), PAIRED),
    (psf.GridFilter(), ONE),
    (psf.GridFilter(), (FREE, {"a": -0.2}, [0.9, 1.2, 0.1], {"steps": [0, 3, 5]})),
    (psf.GuidedPF(N, resample_below=0.0), PAIRED),
    (psf.BootstrapPF(N, resample_below=0.0), PAIRED),
    (psf.EnKF(N), PAIRED),
    (psf.IMM(), SWITCHING),
    (psf.RBPF(N, resample_below=0.0), SWITCHING),
]


@pytest.mark.parametrize(("filter", "record"), CASES, ids=[type(f).__name__ for f, _ in CASES])
@pytest.mark.filterwarnings("ignore::pymc_statespace_filters.errors.FilterWarning")
def test_draws_have_the_moments_of_the_filter(filter, record):
    """Within 5 standard errors of 5000 draws, but for chance once in 50 000 tests."""
    system, params, observed, at = record
    run = psf.run_filter(system, filter, params, observed, **at, seed=3)
    mean, cov = (run[name].values[-1] for name in ("mean", "cov"))
    states = np.tile(run["filter_state"].values, (M, 1))
    law = filter.law_of_state(compile_system(system), states)
    x = law.drawn(np.random.default_rng(1))
    assert (abs(x.mean(axis=0) - mean) < 5 * np.sqrt(np.diag(cov) / M)).all()
    # Its error is .02; the filter divides the spread of weighted members by their number less one.
    np.testing.assert_allclose(np.cov(x.T), cov, atol=0.1 * np.diag(cov).max())


def test_a_member_that_is_not_finite_is_not_drawn():
    states = np.array([[3.0, 1.0, np.nan, 0.0, 0.0], [3.0, np.nan, np.nan, 0.0, 0.0]])
    one, none = law_of_parts(states, exact_states(1)).drawn(np.random.default_rng(1)).ravel()
    assert one == 1.0
    assert np.isnan(none)
