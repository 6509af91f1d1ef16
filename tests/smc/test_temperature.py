"""Temperatures leave a given share of the effective number of points."""

import numpy as np
import pytest

from pymc_statespace_filters.smc.temperature import next_temperature


@pytest.mark.parametrize("share", [0.5, 0.85])
@pytest.mark.parametrize("spread", [1.0, 1e3, 1e9])
@pytest.mark.parametrize("temperature", [0.0, 0.2])
def test_a_share_of_the_effective_number_is_left(temperature, spread, share):
    log_likelihood = -10.0 * spread * np.random.default_rng(86).chisquare(3, 1000)
    log_likelihood[::3] = -np.inf
    raised = next_temperature(temperature, log_likelihood, share)
    weights = np.exp((raised - temperature) * log_likelihood)
    effective = weights.sum() ** 2 / (weights**2).sum()
    assert temperature < raised < 1.0
    assert effective / np.isfinite(log_likelihood).sum() == pytest.approx(share, rel=1e-4)


def test_the_last_temperature_is_one():
    assert next_temperature(0.3, np.array([-1.0, -1.01, -1.02]), 0.85) == 1.0


def test_log_likelihoods_of_all_magnitudes():
    log_likelihood = -np.logspace(40, 60, 100)
    weights = np.exp(next_temperature(0.0, log_likelihood, 0.2) * log_likelihood)
    assert weights.sum() ** 2 / (weights**2).sum() == pytest.approx(20.0, rel=1e-3)
