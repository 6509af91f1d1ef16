"""The error of a mean where the chains disagree, and that of an evidence."""

import math
from dataclasses import replace

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.stats import norm
from scipy.stats import t as student

import pymc_statespace_filters as psf
from pymc_statespace_filters.evidence.checks import check_convergence
from pymc_statespace_filters.evidence.estimators.bridge import Bridge
from pymc_statespace_filters.evidence.estimators.chib_jeliazkov import ChibJeliazkov
from pymc_statespace_filters.evidence.posterior import Posterior
from pymc_statespace_filters.evidence.unreached import check_reached, log_mass_at
from pymc_statespace_filters.statistics.importance import disagreement, mcse_of_chains
from tests.evidence.hard_targets import Funnel
from tests.evidence.targets import Normals, autoregressive

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
    population = np.broadcast_to(np.arange(4)[:, np.newaxis], (4, 100))
    assert "R-hat" in next(check_convergence(posterior))
    assert not list(check_convergence(replace(posterior, population=population)))


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


# An evidence of chains that stayed below the posterior is not passed for that of the posterior.


K = 3
PEAK, WIDTH = np.array([0.4, -0.2, 0.1]), 1e-7


def narrow(height):
    """A narrow peak on a wide normal, and where the wide one is drawn."""

    def log_density(x):
        wide = norm.logpdf(x).sum(axis=-1)
        return np.logaddexp(wide, height + norm.logpdf((x - PEAK) / WIDTH).sum(axis=-1))

    return log_density


def posterior_of(log_density, draws, is_noisy=False):
    flat = draws.reshape(-1, draws.shape[-1])
    values = log_density(flat).reshape(draws.shape[:2])
    return Posterior(
        draws, values, lambda x, rng: log_density(x), is_noisy, prior=Normals(np.ones(K))
    )


def test_the_mass_at_a_peak_of_any_width_and_correlation():
    rng = np.random.default_rng(1)
    chol = 1e-6 * np.tril(rng.standard_normal((4, 4))) + 1e-7 * np.eye(4)
    inverse = np.linalg.inv(chol)

    def log_density(x):
        return 5.0 - 0.5 * ((x @ inverse.T) ** 2).sum(axis=-1)

    truth = 5.0 + 2 * np.log(2 * np.pi) + np.linalg.slogdet(chol)[1]
    start = chol @ rng.standard_normal(4)
    assert log_mass_at(log_density, start, np.ones(4)) == pytest.approx(truth, abs=1e-3)
    assert log_mass_at(lambda x: x[:, 0], start, np.ones(4)) is None  # no mode


@pytest.mark.parametrize(("height", "reached"), [(150.0, False), (45.0, True), (20.0, True)])
def test_the_mass_of_a_higher_peak_decides(height, reached):
    """Its log-mass is the height minus 48: with 45 it is a spike of no mass."""
    draws = autoregressive((4, 500, K), 0.5, np.random.default_rng(2))
    log_density = narrow(height)
    reason = check_reached(posterior_of(log_density, draws), PEAK, 0.0, np.random.default_rng(3))
    assert ("never reached the posterior" in reason) is not reached


def test_the_height_decides_for_a_noisy_likelihood():
    draws = autoregressive((4, 500, K), 0.5, np.random.default_rng(2))
    posterior = posterior_of(narrow(45.0), draws, is_noisy=True)
    assert "45 nats above" not in check_reached(posterior, PEAK + 1, 0.0, np.random.default_rng(3))
    assert "nats above" in check_reached(posterior, PEAK, 0.0, np.random.default_rng(3))


def test_the_neck_of_a_funnel_is_no_unvisited_posterior():
    target, rng = Funnel(8), np.random.default_rng(4)
    posterior = target.posterior((4, 500), rng)
    neck = np.zeros(8)
    neck[0] = -30.0
    assert posterior.log_density.max() + 25 < target.log_density(neck[None])[0]
    assert check_reached(posterior, neck, target.log_evidence, rng) == ""


def test_an_evidence_of_chains_that_were_elsewhere_has_no_error():
    """Chains at the level of the prior, 500 nats below: the search for the maximum finds it."""
    draws = xr.Dataset(
        {"mu": (("chain", "draw"), 5 + 1e-2 * np.random.default_rng(5).standard_normal((4, 500)))}
    )
    idata = xr.DataTree.from_dict({"posterior": draws})
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 10)
        pm.Normal("y", mu, 0.15, observed=[0.2, -0.1])
    with pytest.warns(psf.errors.EvidenceWarning, match="never reached the posterior"):
        found = psf.estimate_evidence(idata, model, random_seed=1, progressbar=False)
    for evidence in found.values():
        assert np.isnan(evidence.se)
        assert "nats above that of the best draw" in evidence.doubts
    with pytest.raises(psf.errors.ModelError, match="never reached the posterior"):
        psf.compare_evidence({"one": idata, "other": idata})
