"""The chain over sub-models, with heights of known probabilities."""

import sys
from types import SimpleNamespace

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.terms import submodel_chains
from pymc_statespace_filters.terms.candidates import read_candidates
from pymc_statespace_filters.terms.doubts import doubts
from pymc_statespace_filters.terms.inclusion import InclusionPrior
from pymc_statespace_filters.terms.maxima import Maxima, proposal_by
from pymc_statespace_filters.terms.probabilities import Probabilities
from pymc_statespace_filters.terms.proposals import Guide
from pymc_statespace_filters.terms.submodel_density import SubmodelDensity
from pymc_statespace_filters.terms.submodel_evidence import Sampler, Visits
from tests.terms.regression import Regression

LOG_POSTERIOR = np.log([[0.2, 0.05], [0.3, 0.45]])  # by the presence of two terms
INCLUSION = [0.75, 0.5]


class NoisyHeights:
    """Estimates of a mean whose logarithm has a standard deviation."""

    def __init__(self, sd, rng):
        self.sd, self.rng = sd, rng
        self.best = np.zeros(2, dtype=bool)
        self.points = {"": SimpleNamespace(proposal=SimpleNamespace(present=self.best))}

    def heights(self, sets, before):
        exact = LOG_POSTERIOR[tuple(sets.astype(int).T)]
        return exact + self.sd * self.rng.standard_normal(len(sets)) - self.sd**2 / 2

    def lost(self, sets):
        return np.zeros(len(sets), dtype=bool)


@pytest.mark.parametrize("sd", [0.0, 0.7])
def test_visits_are_as_frequent_as_probable(sd, monkeypatch):
    """Whatever the noise of the estimates. Fails by chance once in 4000."""
    rng = np.random.default_rng(3)
    monkeypatch.setattr(submodel_chains, "_Met", lambda *args: NoisyHeights(sd, rng))
    monkeypatch.setattr(submodel_chains, "N_STEPS", 8000)
    prior = InclusionPrior(None, np.zeros((2, 2), dtype=bool))
    guide = SimpleNamespace(distances=np.array([1.5, 2.5]))
    visits = submodel_chains.run_chains(prior, guide, None, rng, lambda task, total: None)
    assert (visits.error < 0.01).all()
    np.testing.assert_array_less(abs(visits.frequency - INCLUSION), 4 * visits.error)
    assert not visits.alone.any()
    np.testing.assert_array_equal(visits.missed(visits.frequency), 0.0)


class Independent:
    """Exact heights of terms that are present independently of each other."""

    def __init__(self, log_odds):
        self.log_odds, self.points = log_odds, {}
        self.best = np.zeros(len(log_odds), dtype=bool)

    def heights(self, sets, before):
        for one in sets.copy():
            self.points[one.tobytes()] = SimpleNamespace(proposal=SimpleNamespace(present=one))
        return sets @ self.log_odds

    def lost(self, sets):
        return np.zeros(len(sets), dtype=bool)


@pytest.mark.parametrize(
    ("frequency", "error", "most"),
    [
        (0.8, 0.5, np.sqrt((0.06**2 + 0.12**2) / 2)),  # by what each chain has visited alone
        (0.35, 0.03, np.hypot(0.05, 0.03)),  # by frequencies, which are more certain
    ],
)
def test_how_far_an_inclusion_may_move(frequency, error, most):
    visits = Visits(
        sets=np.array([[True]]),
        points=[],
        frequency=np.array([frequency]),
        error=np.array([error]),
        alone=np.array([0.1, 0.3]),
        frequency_alone=np.array([[0.1], [0.0]]),
    )
    np.testing.assert_allclose(visits.missed(np.array([0.4])), most)


def test_what_was_not_met_is_part_of_the_error(monkeypatch):
    """Of 2^16 sub-models, a few hundred: by evidences without error, of 12 runs."""
    inclusion = np.concatenate([np.full(8, 0.05), np.full(8, 0.2)])
    log_odds = np.log(inclusion / (1 - inclusion))
    monkeypatch.setattr(submodel_chains, "N_STEPS", 400)
    prior = InclusionPrior(None, np.zeros((16, 16), dtype=bool))
    guide = SimpleNamespace(distances=np.linspace(0, 3, 16))
    z, shares = [], []
    for seed in range(12):
        met = Independent(log_odds)
        monkeypatch.setattr(submodel_chains, "_Met", lambda *args, met=met: met)
        rng = np.random.default_rng(seed)
        visits = submodel_chains.run_chains(prior, guide, None, rng, lambda task, total: None)
        found = Probabilities(
            visits.sets, visits.sets @ log_odds, *np.zeros((2, len(visits.sets)))
        ).inclusion
        shares.append(visits.alone.mean())
        z.append((found - inclusion) / visits.missed(found))
    assert 0.1 < np.median(shares) < 0.3
    assert 0.5 < np.mean(np.square(z)) < 4.0


# Proposals by maxima: exact for a regression, whose sub-models have normal posteriors.


SELECT = sys.modules["pymc_statespace_filters.terms.select_terms"]


class Search:
    """The maxima of a model's sub-models, with normal draws for a guide."""

    def __init__(self, model, absent, scale=3.0):
        rng = np.random.default_rng(5)
        self.density = SubmodelDensity(model, read_candidates(model, absent))
        draws = scale * rng.standard_normal((500, len(self.density.blocks)))
        self.guide = Guide(self.density, draws, draws, rng)
        self.sampler = Sampler(self.density, self.guide.base, rng)
        self.maxima = Maxima(self.density, self.guide, self.sampler, rng)

    def of(self, present, known):
        return self.maxima.of(self.guide.proposal(present), known)


def test_maxima_have_the_evidence_of_normal_posteriors():
    """From draws far away, and one term after the other added, or dropped again."""
    regression = Regression(3, n_terms=5)
    with pm.Model() as model:
        b = pm.Normal("b", 0, 1, shape=5)
        pm.Normal("y", regression.inputs @ b, 1.0, observed=regression.y)
    search = Search(model, {"b": 0.0})
    sets = np.tril(np.ones((6, 5), dtype=bool), -1)[1:-1]  # without the half-normal term
    known = []
    for present in [*sets, *sets[::-1]]:
        known = search.of(present, known)
        [exact] = [
            value
            for one, value in zip(regression.sets, regression.log_evidence, strict=True)
            if np.array_equal(one, present)
        ]
        assert len(known) == 1
        np.testing.assert_allclose(known[0].log_evidence, exact, atol=1e-3)
        [points] = search.sampler.draw([proposal_by(known, search.guide.proposal(present))], [1000])
        assert points.efficiency > 0.4
        np.testing.assert_allclose(points.mean.value, exact, atol=4 * points.mean.error)


def hidden_signs():
    """The product of two coefficients is known, and their signs are not."""
    rng = np.random.default_rng(8)
    u = rng.standard_normal((3, 200))
    y = 1.2 * u[0] + 0.5 * u[1] + 0.2 * rng.standard_normal(200)
    with pm.Model() as model:
        a, b, c = (pm.Normal(name, 0, 1) for name in "abc")
        pm.Normal("y", a * b * u[0] + b**2 * u[1] + c * u[2], 0.2, observed=y)
    return model, dict.fromkeys("abc", 0.0)


def test_other_signs_are_other_maxima():
    search = Search(*hidden_signs(), scale=1.0)
    known = []
    for present in np.array([[0, 1, 0], [1, 1, 0], [1, 1, 1]], dtype=bool):
        known = search.of(present, known)
        assert len(known) == 2
        np.testing.assert_allclose(known[0].log_evidence, known[1].log_evidence, atol=0.05)
        a, b = ([one.point[i] for one in known] for i in (0, 1))
        assert b[0] * b[1] < 0
        if present[0]:
            assert a[0] * b[0] > 0
            assert a[1] * b[1] > 0


def test_chains_that_learn_where_sub_models_are(monkeypatch):
    """The draws say little, the chains start with no term, and the probabilities are exact."""
    monkeypatch.setattr(SELECT, "MOST_COUNTED", 3)
    monkeypatch.setattr(SELECT, "NO_GUIDE", 1.1)  # whatever the draws are
    monkeypatch.setattr(submodel_chains, "N_STEPS", 300)
    regression = Regression(3, n_terms=4)
    rng = np.random.default_rng(7)
    b = 2 + 0.1 * rng.standard_normal((4, 2, 300))
    posterior = {f"b{i}": (("chain", "draw"), abs(one)) for i, one in enumerate(b)}
    idata = xr.DataTree.from_dict({"posterior": xr.Dataset(posterior)})
    terms = psf.select_terms(
        regression.model(as_system=False),
        regression.absent,
        idata=idata,
        random_seed=4,
        progressbar=False,
    )["terms"]
    # Of 8 normal errors the largest is below 4 but for one time in 2000.
    truth = regression.inclusion()
    assert (np.abs(terms["inclusion"] - truth) < 4 * terms["inclusion_se"] + 1e-3).all()
    assert (np.abs(terms["visits"] - truth) < 4 * terms["visits_se"]).all()


def test_advice_where_draws_are_no_guide():
    found = SimpleNamespace(of_models=np.array([1.0]), present=np.array([[True]]))
    points = [SimpleNamespace(is_reliable=False, n_effective=3.0, pareto_k=0.9)]
    named = SimpleNamespace(labels=["b"])
    [doubt] = doubts(found, points, named, None, None)
    assert "the draws of the full model are no guide" in doubt


@pytest.mark.parametrize("keys", [[("a", "b")], ["a", "b", "c"]])
@pytest.mark.parametrize("is_noisy", [False, True])
def test_advice_is_of_what_there_is(keys, is_noisy):
    """Of particles, a few terms, and terms of one variable."""
    present = np.ones((1, len(keys)), dtype=bool)
    found = SimpleNamespace(of_models=np.array([1.0]), present=present)
    seeds = np.zeros((9, int(is_noisy)))
    point = SimpleNamespace(is_reliable=False, n_effective=30.0, pareto_k=0.3, seeds=seeds)
    [doubt] = doubts(found, [point], Named(keys), None, point)
    assert "give more draws of the full model" in doubt
    assert ("particles" in doubt) == is_noisy
    assert ("compare_evidence" in doubt) == (len(keys) == 1)
    assert ("a gap" in doubt) == (len(keys) > 1)


class Named(SimpleNamespace):
    """Candidates by their names alone."""

    def __init__(self, keys):
        super().__init__(keys=keys, labels=["".join(key) for key in keys])

    def __len__(self):
        return len(self.keys)
