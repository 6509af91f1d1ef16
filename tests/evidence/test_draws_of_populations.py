"""Estimates from draws of `sample_smc`, of which only the populations are independent."""

from dataclasses import replace

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.stats import norm

from pymc_statespace_filters.advice import missed
from pymc_statespace_filters.errors import EvidenceWarning, ModelError
from pymc_statespace_filters.evidence import estimation
from pymc_statespace_filters.evidence.comparison.scaled_prior import average_ratios
from pymc_statespace_filters.evidence.evidence_facts import PartsOfPosterior
from pymc_statespace_filters.evidence.pooled import Pooled
from pymc_statespace_filters.evidence.posterior import Posterior
from pymc_statespace_filters.evidence.reweighting.correction import correct
from pymc_statespace_filters.evidence.shorter_steps import _change
from pymc_statespace_filters.facts import sentences
from pymc_statespace_filters.pymc_model.posterior_draws import BY_PARTICLES, populations_of
from pymc_statespace_filters.statistics.importance import mcse, mcse_of_populations
from tests.evidence.targets import Regression

R, N, SCATTER = 8, 100, 0.4


def log_density(x):
    return norm.logpdf(x).sum(axis=-1)


def particles(rng):
    """Draws of N(0, 1) in 4 chains, of populations of unequal sizes with means of their own."""
    population = np.sort(rng.choice(R, size=R * N, p=np.arange(1, R + 1) / (R * (R + 1) / 2)))
    means = SCATTER * rng.standard_normal((R, 2))
    within = np.sqrt(1 - SCATTER**2) * rng.standard_normal((R * N, 2))
    x = (means[population] + within).reshape(4, -1, 2)
    return Posterior(
        x, log_density(x), lambda x, rng: log_density(x), population=population.reshape(4, -1)
    )


def in_turn(scatter):
    """A term of each draw, 4 populations in turn along one chain, whose means cancel there."""
    population = np.broadcast_to(np.arange(800) % 4, (1, 800))
    terms = np.random.default_rng(2).standard_normal((1, 800))
    return terms + scatter * np.array([-1.5, -0.5, 0.5, 1.5])[population], population


def of_step_error(terms, population):
    found = _change(np.zeros((*terms.shape, 1)), 0.01 * terms[..., None], population)
    return [found.log_lik_se, found.log_evidence_se]


def of_scaled_priors(terms, population):
    return [average_ratios(0.1 * terms, np.zeros(terms.shape), population).error]


def of_weights(terms, population):
    """Points of the target itself beside the draws, so that the constants cost nothing."""
    logs = np.append(0.1 * terms.ravel(), np.zeros(200))
    pooled = Pooled(terms.shape, logs, np.zeros(1000), np.zeros(1000), population)
    return [pooled.log_evidence().error, pooled.effective_size(logs[:, None]) ** -0.5]


@pytest.mark.parametrize("errors_of", [of_step_error, of_scaled_priors, of_weights])
def test_errors_of_populations_whose_draws_alternate(errors_of):
    """As chains they look like 800 independent draws, or better; they are worth four."""
    terms, population = in_turn(0.6)
    as_chains, as_populations = errors_of(terms, None), errors_of(terms, population)
    assert (np.divide(as_populations, as_chains) > 10).all()


def test_weighted_draws_keep_their_populations():
    target = Regression(2, 8, np.random.default_rng(1))
    posterior = target.posterior((4, 200), np.random.default_rng(2))
    population = np.arange(800).reshape(4, 200) // 100
    posterior = replace(posterior, population=population)
    kept = posterior.at(np.s_[:, ::2])

    def evaluate(x, seeds):
        return posterior.evaluate(x, np.random.default_rng(1))[:, None]

    found = correct(posterior, kept, evaluate, (1, 0), np.random.default_rng(3))
    np.testing.assert_array_equal(found.pooled.population, population[:, ::2])
    assert found.pooled.shape == (4, 100)


def test_draws_of_one_population_have_no_error():
    assert np.isinf(mcse(np.arange(8.0).reshape(2, 4), np.zeros((2, 4), dtype=int)))


def test_halves_for_a_fit_are_of_all_populations():
    posterior = particles(np.random.default_rng(1))
    for half in posterior.halves_for_fit():
        assert half.draws.shape == (4, 100, 2)
        assert set(np.unique(half.population)) == set(range(R))
    chains = replace(posterior, population=None)
    for one, other in zip(chains.halves_for_fit(), chains.halves(), strict=True):
        np.testing.assert_array_equal(one.draws, other.draws)


class TestModel:
    """Draws from the posterior of one normal mean, labelled as those of `sample_smc`."""

    @pytest.fixture
    def model(self):
        with pm.Model() as model:
            pm.Normal("y", pm.Normal("mu", 0, 2), 1, observed=[0.3, -0.4, 1.1])
        return model

    @staticmethod
    def idata(n_populations):
        mu = 4 / 13 + np.random.default_rng(1).standard_normal((4, 200)) / np.sqrt(3.25)
        population = np.arange(800).reshape(4, 200) * n_populations // 800
        tree = az.from_dict({"posterior": {"mu": mu}, "sample_stats": {"population": population}})
        tree.attrs["sampler"] = BY_PARTICLES
        return tree

    def test_one_population_is_enough_for_importance_sampling(self, model):
        found = estimation.estimate_evidence(self.idata(1), model, random_seed=1)["importance"]
        assert abs(found.log_evidence - (-4.6154)) < 4 * found.se < 0.2

    def test_no_other_takes_them(self, model):
        idata, message = self.idata(8), r"of sample_smc, .* estimators='importance', got \['{}'\]"
        with pytest.raises(ModelError, match=message.format("bridge")):
            estimation.estimate_evidence(idata, model, estimators=["importance", "bridge"])
        with pytest.raises(ModelError, match=message.format("chib_jeliazkov")):
            estimation.chib_jeliazkov(idata, model)

    def test_a_poor_fit_is_not_sent_to_an_estimator_that_refuses_them(self, model):
        with model, pytest.warns(EvidenceWarning, match="the evidence that sample_smc has stored"):
            estimation.estimate_evidence(self.idata(8), target_se=1e-4, random_seed=1)


def test_the_error_of_a_mean_is_that_of_unequal_clusters():
    terms, population = np.array([1.0, 3.0, 5.0, 5.0]), np.array([0, 0, 1, 1])
    expected = np.sqrt(2 * (0.25 * 1.5**2 * 2)) * 12.706 / 1.96
    assert mcse_of_populations(terms, population) == pytest.approx(expected, rel=1e-3)


def test_populations_are_read_from_the_result():
    posterior = xr.Dataset({"x": (("chain", "draw"), np.zeros((2, 3)))})
    tree = xr.DataTree.from_dict({"posterior": posterior})
    assert populations_of(tree) is None
    tree.attrs["sampler"] = BY_PARTICLES
    assert populations_of(tree).tolist() == [[0, 0, 0], [1, 1, 1]]
    stats = xr.Dataset({"population": (("chain", "draw"), [[0, 0, 0], [0, 1, 1]])})
    tree["sample_stats"] = xr.DataTree(stats)
    assert populations_of(tree).tolist() == [[0, 0, 0], [0, 1, 1]]


def test_what_chains_have_missed_is_not_looked_for_in_populations(monkeypatch):
    monkeypatch.setattr(missed, "unvisited", lambda *args: ["the chains have missed a part"])
    x = np.zeros((4, 1000, 2))
    posterior, rng = Posterior(x, log_density(x), log_density), np.random.default_rng(1)
    tree = xr.DataTree()
    assert sentences(PartsOfPosterior(tree, None, posterior, rng))
    tree.attrs["sampler"] = BY_PARTICLES
    assert not sentences(PartsOfPosterior(tree, None, posterior, rng))


def test_the_default_is_importance_sampling(monkeypatch):
    chosen = []

    def run(idata, model, estimators, **settings):
        chosen.append([one.name for one in estimators])
        return {}

    monkeypatch.setattr(estimation, "run_estimators", run)
    tree = xr.DataTree()
    estimation.estimate_evidence(tree, pm.Model())
    tree.attrs["sampler"] = BY_PARTICLES
    estimation.estimate_evidence(tree, pm.Model())
    assert chosen == [["chib_jeliazkov", "bridge"], ["importance"]]
