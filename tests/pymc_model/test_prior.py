"""Draws from a model's prior, and its density: one law on the unconstrained space."""

import numpy as np
import pymc as pm
import pytest
from pymc.distributions.transforms import log, ordered
from scipy.special import expit, logsumexp
from scipy.stats import halfnorm, kstest, norm

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.pymc_model import prior_draws
from pymc_statespace_filters.pymc_model.density import ModelDensity
from pymc_statespace_filters.pymc_model.prior import ModelPrior, Support
from pymc_statespace_filters.pymc_model.prior_draws import PriorDraws

N = 4000


@pytest.fixture(scope="module")
def model():
    """A hierarchy, a bound that varies, a vector, a simplex; and what is no part of the prior."""
    with pm.Model() as model:
        upper = pm.HalfNormal("upper", 2)
        sd = pm.Uniform("sd", 0, upper)
        pm.Normal("x", [0.0, 10.0], sd, shape=2)
        w = pm.Dirichlet("w", [1.0, 2.0, 3.0])
        pm.Potential("tilt", 100 * upper)
        pm.Normal("y", w[0], 1, observed=[0.3])
    return model


@pytest.fixture(scope="module")
def draws(model):
    return ModelPrior(model).sample(N, np.random.default_rng(1))


def test_the_law_of_every_variable(draws):
    """Kolmogorov-Smirnov tests of level 0.001, five of them: 0.5 per cent fail if all is right."""
    upper = np.exp(draws[:, 0])
    share = expit(draws[:, 1])
    x = (draws[:, 2:4] - [0.0, 10.0]) / (share * upper)[:, None]
    assert draws.shape == (N, 6)
    assert kstest(upper, halfnorm(scale=2).cdf).pvalue > 1e-3
    assert kstest(share, "uniform").pvalue > 1e-3
    for column in x.T:
        assert kstest(column, norm.cdf).pvalue > 1e-3
    exponents = np.column_stack([draws[:, 4:], -draws[:, 4:].sum(axis=1)])
    w = np.exp(exponents - logsumexp(exponents, axis=1, keepdims=True))
    assert kstest(w[:, 0], lambda p: 1 - (1 - p) ** 5).pvalue > 1e-3  # Beta(1, 5)


@pytest.mark.parametrize("is_known", [True, False])
def test_many_draws_in_one_call_are_one_call_for_each(model, draws, is_known, monkeypatch):
    """To rounding in transforms; a half-Cauchy is drawn one by one."""
    with model if is_known else pm.Model() as own:
        if not is_known:
            pm.Normal("x", pm.HalfCauchy("scale", 1), [1.0, 2.0])
    together = PriorDraws(own, own.free_RVs)
    assert together._is_joint == is_known
    monkeypatch.setattr(prior_draws, "_first_parameters", lambda outputs: [])
    alone = PriorDraws(own, own.free_RVs)
    found, expected = (one(150, np.random.default_rng(1)) for one in (together, alone))
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
    if is_known:
        np.testing.assert_array_equal(found, draws[:150])


def _interpolated():
    grid = np.linspace(0, 1, 5)
    pm.Normal("x", pm.Interpolated("middle", grid, 1 + grid), 1)


def _with_a_shape_of_another():
    middle = pm.Normal("middle", [0.0, 10.0], 1)
    pm.Normal("x", middle[0], 1, shape=middle.shape)


def _with_a_number_that_is_an_index():
    group = pm.Data("group", [0, 1, 1])
    pm.Normal("x", pm.Normal("middle", [0.0, 10.0], 1)[group], 1)
    pm.Normal("y", group, 1)


@pytest.mark.parametrize(
    ("build", "is_joint"),
    [(_interpolated, False), (_with_a_shape_of_another, False),
     (_with_a_number_that_is_an_index, True)],
)  # fmt: skip
def test_what_pytensor_does_not_draw_many_times_in_one_call(build, is_joint, monkeypatch):
    with pm.Model() as model:
        build()
    draws = PriorDraws(model, model.free_RVs)
    assert draws._is_joint == is_joint
    monkeypatch.setattr(prior_draws, "_first_parameters", lambda outputs: [])
    alone = PriorDraws(model, model.free_RVs)
    found, expected = (one(5, np.random.default_rng(1)) for one in (draws, alone))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_columns_and_rows_are_independent_where_the_law_says_so(draws):
    """Six correlations, each within 4 standard errors: 0.04 per cent fail if all is right."""
    share, upper = expit(draws[:, 1]), draws[:, 0]
    x = (draws[:, 2:4] - [0.0, 10.0]) / (share * np.exp(upper))[:, None]
    correlation = np.corrcoef(np.column_stack([upper, share, x]).T)[np.triu_indices(4, 1)]
    assert (np.abs(correlation) < 4 / np.sqrt(N)).all()
    assert len(np.unique(draws[:, 0])) == N


def test_density_and_draws_are_one_law(model, draws):
    """The mean of q(x) / p(x) over draws of p is one for any density q: here a Gaussian's.

    The tails of q are kept below those of p; five standard errors fail once in a million.
    """
    centre, scale = np.median(draws, axis=0), 0.5 * np.subtract(*np.quantile(draws, [0.7, 0.3], 0))
    log_q = norm.logpdf(draws, centre, np.abs(scale)).sum(axis=1)
    ratio = np.exp(log_q - ModelPrior(model).log_density(draws))
    error = ratio.std() / np.sqrt(N)
    assert error < 0.2
    assert abs(ratio.mean() - 1) < 5 * error


def test_potentials_belong_to_the_likelihood(model, draws):
    x = draws[:3]
    likelihood = ModelDensity(model).evaluate(x, np.empty((3, 0), dtype=np.int64))
    likelihood = likelihood - ModelPrior(model).log_density(x)
    w0 = np.exp(x[:, 4]) / (np.exp(x[:, 4:]).sum(axis=1) + np.exp(-x[:, 4:].sum(axis=1)))
    expected = norm.logpdf(0.3, w0) + 100 * np.exp(x[:, 0])
    np.testing.assert_allclose(likelihood, expected, rtol=1e-9)


def test_the_generator_decides_the_draws(model):
    prior = ModelPrior(model)
    one, same, other = (prior.sample(5, np.random.default_rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    assert not np.isin(one, other).any()
    rng = np.random.default_rng(3)
    assert not np.isin(prior.sample(5, rng), prior.sample(5, rng)).any()


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (lambda: pm.Flat("free"), "the prior of free is improper and cannot be sampled"),
        (
            lambda: pm.Normal("free", shape=2, transform=ordered, initval=[0, 1]),
            "the prior of free cannot be sampled: its transform excludes a part",
        ),
        (
            lambda: pm.CustomDist("free", 1.0, logp=lambda value, mu: -((value - mu) ** 2)),
            "the prior cannot be sampled: .*_free'",
        ),
        (
            lambda: pm.Normal("free", 0.0, pm.Normal("tau", shape=2)),
            r"the prior of free cannot be drawn at some values of tau \(scale < 0\): give these",
        ),
        (
            lambda: pm.Beta("free", 1e-3, 1e-3),
            r"\d+ of 20 draws of the prior are rounded to the edge of their support",
        ),
        (
            lambda: pm.Censored("free", pm.Normal.dist(), lower=-1, upper=1),
            r"\d+ of 20 draws of the prior of free repeat a value",
        ),
    ],
)
def test_priors_that_cannot_be_drawn_from(prior, message):
    with pm.Model() as model:
        pm.Normal("fine")
        prior()
    with pytest.raises(ModelError, match=message):
        ModelPrior(model).sample(20, np.random.default_rng(1))


# What an evidence owes to the supports of its priors, and how it says so.


DATA = np.array([0.3, 1.2, 0.8])


def test_volumes_of_scalars_vectors_and_dependent_bounds():
    with pm.Model() as model:
        pm.Uniform("a", 0, 200)
        pm.Uniform("b", [-1.0, -2.0], 0.0)
        pm.Uniform("c", 0, pm.Data("width", 5.0), shape=3, default_transform=None)
        upper = pm.HalfNormal("upper", 1)
        pm.Uniform("d", 0, upper)  # no constant volume
        pm.Beta("e", 1, 1)  # uniform by accident
        pm.Uniform("y", 0, 10, observed=DATA)
    support = Support.of(model)
    assert support.log_volume == pytest.approx(np.log(200 * 1 * 2 * 5**3), rel=1e-14)
    assert support.uniform == "a, b, c"
    assert support.improper == ""
    assert not list(support.check())


def test_densities_without_an_integral_or_with_another_one():
    with pm.Model() as model:
        pm.Flat("flat", shape=2)
        half = pm.HalfFlat("half")
        pm.GaussianRandomWalk("walk", init_dist=pm.Flat.dist(), shape=3)
        pm.ICAR("field", W=np.array([[0, 1], [1, 0]]))
        pm.Normal("sorted", 0, 1, shape=3, transform=ordered, initval=[0, 1, 2])
        pm.Normal("positive", 0, 1, transform=log)
        pm.Normal("proper_given", 0, half)  # its own density is proper, whatever its scale's is
        pm.Uniform("interval", 0, half)
        pm.HalfNormal("log")
        pm.Dirichlet("simplex", np.ones(3))
        pm.VonMises("angle", 0, 1)
        pm.ZeroSumNormal("zero_sum", 1, shape=3)
        pm.Truncated("truncated", pm.Normal.dist(0, 1), lower=0, upper=1)
        pm.LKJCholeskyCov("chol", n=2, eta=1, sd_dist=pm.HalfNormal.dist(1), compute_corr=False)
    support = Support.of(model)
    assert support.improper == "flat, half, walk, field, sorted, positive"
    of_transforms, of_others = support.check()
    assert "the prior of sorted, positive, which is not normalised" in of_transforms
    assert "the prior of flat, half, walk, field is improper" in of_others
    assert "depends on the units of the parameters: give them proper priors" in of_others
