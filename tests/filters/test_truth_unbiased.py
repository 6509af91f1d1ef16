"""The bootstrap filter's likelihood has the right mean, however rarely it resamples."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.references.records import OSCILLATOR, oscillator_with_gaps
from tests.systems import linear_system, log_likelihoods

N_SEEDS = 8_000
N_OBSERVATIONS = 9  # with gaps in both components, and one row wholly missing


@pytest.mark.parametrize(("n_particles", "resample_below"), [(80, 1.0), (400, 0.0), (80, 1 / 3)])
def test_mean_of_the_likelihood_is_exact(n_particles, resample_below):
    """Three standard errors: a right filter fails once in 370 (the seeds are fixed)."""
    record = oscillator_with_gaps()
    steps, observed = record.steps[:N_OBSERVATIONS], record.observed[:N_OBSERVATIONS]
    exact = kalman_log_likelihood(*OSCILLATOR.kalman_arguments(), steps=steps, observed=observed)
    filter = psf.BootstrapPF(n_particles, resample_below=resample_below)
    record = {"observed": observed, "steps": steps}
    found = log_likelihoods(linear_system(OSCILLATOR), filter, {}, np.arange(N_SEEDS), **record)
    log_ratio = found - exact.sum()
    assert 0.1 < log_ratio.var() < 1.0  # noisy enough to tell a mean of logs from a log of means
    ratio = np.exp(log_ratio)
    standard_error = ratio.std(ddof=1) / np.sqrt(N_SEEDS)
    assert abs(ratio.mean() - 1.0) < 3.0 * standard_error
    assert log_ratio.mean() < -10.0 * standard_error
