"""The error of a mean where the chains disagree, and that of an evidence."""

import math

import numpy as np
import pytest
import xarray as xr
from scipy.stats import norm
from scipy.stats import t as student

from pymc_statespace_filters.evidence.checks import check_convergence
from pymc_statespace_filters.evidence.estimators.bridge import Bridge
from pymc_statespace_filters.evidence.estimators.chib_jeliazkov import ChibJeliazkov
from pymc_statespace_filters.evidence.posterior import Posterior
from pymc_statespace_filters.statistics.importance import disagreement, mcse_of_chains
from tests.evidence.targets import autoregressive

N_RUNS = 400


def covered(between, n_chains=4, n_draws=200):
    """How often 95 % intervals of a mean hold, of chains whose levels scatter, and their width."""
    rng = np.random.default_rng(1)
    levels = between * rng.standard_normal((N_RUNS, n_chains, 1))
    terms = levels + autoregressive((N_RUNS, n_draws, n_chains), 0.5, rng).swapaxes(1, 2)
    errors = np.array([mcse_of_chains(one) for one in terms])
    return np.mean(np.abs(terms.mean(axis=(1, 2))) < 1.96 * errors), np.median(errors)


def test_chains_that_agree_keep_the_error_of_their_autocorrelation():
    share, width = covered(0.0)
    assert share == pytest.approx(0.95, abs=0.03)
    assert width == pytest.approx(math.sqrt(3 / 800), rel=0.1)  # (1 + 0.5) / (1 - 0.5) per draw


@pytest.mark.parametrize(("between", "least"), [(0.5, 0.86), (3.0, 0.92)])
def test_intervals_hold_where_chains_disagree(between, least):
    """Of 400 intervals of probability 0.95 fewer than 92 % hold once in 100 times.

    Chains whose levels scatter by four of their standard errors often agree by chance.
    """
    share, _ = covered(between)
    assert share > least


def test_the_error_is_that_of_the_jackknife_over_chains():
    terms = autoregressive((1000, 1, 4), 0.0, np.random.default_rng(2))[:, 0].T
    terms = terms + 10 * np.array([[0.3], [-1.0], [0.8], [0.4]])
    left_out = [np.delete(terms, i, axis=0).mean() for i in range(4)]
    jackknife = math.sqrt(3 / 4 * np.sum((left_out - np.mean(left_out)) ** 2))
    assert mcse_of_chains(terms) == pytest.approx(jackknife * student.ppf(0.975, 3) / 1.96)
    assert mcse_of_chains(terms[:1]) < 0.1  # one chain has nothing to disagree with


def test_disagreement_is_named_from_an_r_hat():
    terms = autoregressive((4, 500, 1), 0.5, np.random.default_rng(3))[..., 0]
    assert disagreement(terms) == ""
    assert disagreement(np.zeros((4, 500))) == ""
    assert "R-hat" in disagreement(terms + np.array([[0.0], [0.0], [0.0], [1.0]]))


def test_populations_of_particles_are_no_chains():
    """Their draws have common ancestors, and R-hat says nothing of them."""
    draws = autoregressive((4, 100, 1), 0.5, np.random.default_rng(6))
    draws += np.array([0.0, 0.5, 1.0, 1.5])[:, np.newaxis, np.newaxis]
    posterior = Posterior(draws, norm.logpdf(draws[..., 0]), lambda x, rng: norm.logpdf(x[..., 0]))
    of_chains, of_particles = xr.DataTree(), xr.DataTree()
    of_particles.attrs["sampler"] = "smc"
    assert "R-hat" in next(check_convergence(posterior, of_chains))
    assert not list(check_convergence(posterior, of_particles))


@pytest.mark.parametrize("estimator", [ChibJeliazkov(), Bridge()])
def test_an_estimator_names_chains_that_disagree_about_its_terms(estimator):
    """One chain has the spread of the posterior, the others half of it; all have its mean."""
    draws = autoregressive((4, 500, 1), 0.5, np.random.default_rng(4))
    draws[1:] *= 0.3

    def log_density(x):
        return norm.logpdf(x[..., 0])

    posterior = Posterior(draws, log_density(draws), lambda x, rng: log_density(x))
    found = estimator.estimate(posterior, rng=np.random.default_rng(5))
    assert any("the chains disagree about the averaged terms" in doubt for doubt in found.doubts)
