"""Labels that may be exchanged: declared, all orders count; else the evidence is doubted."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
import xarray as xr
from scipy.special import logsumexp
from scipy.stats import norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.checks.coverage.sentences import store
from pymc_statespace_filters.errors import EvidenceWarning, ModelError
from pymc_statespace_filters.evidence.exchangeable_labels import OneOrder, undeclared_labels
from pymc_statespace_filters.evidence.labels import Labels
from pymc_statespace_filters.evidence.posterior import Posterior
from pymc_statespace_filters.pymc_model.density import ModelDensity
from pymc_statespace_filters.pymc_model.posterior_draws import unconstrained_draws

DATA = np.array([-2.1, -1.6, -2.4, -1.9, -2.2, 1.8, 2.3, 1.7, 2.0, 2.6])
ORDERED = pm.distributions.transforms.ordered
GRID = np.linspace(-7, 7, 561)
WIDTH = GRID[1] - GRID[0]


def log_joint(prior_means=(0.0, 0.0)):
    """Log prior times likelihood of two means on the grid, (561, 561)."""
    of_each = norm.logpdf(DATA[:, None], GRID)
    likelihood = np.logaddexp(of_each[:, :, None], of_each[:, None, :]) - np.log(2)
    prior = [norm.logpdf(GRID, mean, 3) for mean in prior_means]
    return likelihood.sum(axis=0) + prior[0][:, None] + prior[1]


TRUTH = logsumexp(log_joint()) + 2 * np.log(WIDTH)


def draws_of(joint, only=None, seed=1):
    """Independent draws of the posterior, of one order of the means if it is named."""
    rng = np.random.default_rng(seed)
    weights = np.exp(joint - joint.max()).ravel()
    i, j = np.unravel_index(rng.choice(weights.size, 3200, p=weights / weights.sum()), joint.shape)
    means = np.stack([GRID[i], GRID[j]], axis=-1) + WIDTH * rng.uniform(-0.5, 0.5, (3200, 2))
    if only == "ascending":
        means.sort(axis=-1)
    return tree(mu=means.reshape(4, 800, 2))


def tree(**draws):
    """Draws (chain, draw, ...) by name."""
    dims = {name: [f"{name}_{i}" for i in range(one.ndim - 2)] for name, one in draws.items()}
    posterior = {name: (("chain", "draw", *dims[name]), one) for name, one in draws.items()}
    return xr.DataTree.from_dict({"posterior": xr.Dataset(posterior)})


def mixture(prior_means=(0.0, 0.0), transform=None):
    with pm.Model() as model:
        settings = {} if transform is None else {"transform": transform, "initval": [-1.0, 1.0]}
        mu = pm.Normal("mu", np.array(prior_means), 3, shape=2, **settings)
        of_each = [pm.logp(pm.Normal.dist(mu[k], 1), DATA) - np.log(2) for k in range(2)]
        pm.Potential("likelihood", pt.logaddexp(*of_each).sum())
    return model


def evidences(idata, model, *estimators, **settings):
    settings = {"random_seed": 2, "progressbar": False} | settings
    return psf.estimate_evidence(idata, model, estimators=estimators or None, **settings)


@pytest.mark.parametrize(
    ("transform", "advice"),
    [(None, r"labels of mu .* lack up to ln 2! = 0\.693 .*exchangeable=\['mu'\]"),
     (ORDERED, r"part of the prior of mu, which is not normalised.*exchangeable=\[")],
)  # fmt: skip
def test_one_order_is_doubted_until_the_labels_are_declared(transform, advice):
    idata, model = draws_of(log_joint(), "ascending"), mixture(transform=transform)
    if transform is None:  # what the end of a run has said of the same
        store(idata, ["the chains have missed a separate mode"])
    with pytest.warns(EvidenceWarning, match=advice) as caught:
        found = evidences(idata, model)
    assert len(caught) == 1
    assert found.agreement
    for one in found.values():
        assert one.log_evidence + np.log(2) == pytest.approx(TRUTH, abs=4 * one.se + 1e-3)
        assert "exchangeable=" in one.doubts
        assert "a separate mode" not in one.doubts
    for one in evidences(idata, model, exchangeable=["mu"]).values():
        assert one.log_evidence == pytest.approx(TRUTH, abs=4 * one.se + 1e-3)
        assert (one.doubts, one.improper) == ("", "")


@pytest.mark.parametrize("exchangeable", [None, "mu", ()])
def test_draws_of_both_orders_give_the_same_evidence(exchangeable):
    settings = {"exchangeable": exchangeable}
    found = evidences(draws_of(log_joint()), mixture(), "importance", **settings)["importance"]
    assert found.log_evidence == pytest.approx(TRUTH, abs=4 * found.se + 1e-3)


@pytest.mark.parametrize("stays", [False, True])
def test_so_many_labels_that_no_draws_visit_all_orders(stays):
    """Seven alike have 5040 orders: draws are doubted if they stay in one, not otherwise."""
    with pm.Model() as model:
        pm.Normal("z", 0, 1, shape=7)
    z = np.random.default_rng(3).normal(size=(4, 500, 7))
    idata = tree(z=np.sort(z) if stays else z)
    check(model, idata, "z" if stays else "", 7, ["z"])


def test_labels_that_are_none():
    means = (-1.0, 1.5)
    idata = draws_of(log_joint(means))
    truth = logsumexp(log_joint(means)) + 2 * np.log(WIDTH)
    found = evidences(idata, mixture(means), "importance")["importance"]
    assert found.log_evidence == pytest.approx(truth, abs=4 * found.se + 1e-3)
    with pytest.raises(ModelError, match=r"exchange leaves the density as it is, got \['mu'\]"):
        evidences(idata, mixture(means), exchangeable="mu")


def test_an_order_that_is_half_of_an_asymmetric_prior_is_improper():
    means = (-1.0, 1.5)
    idata, model = draws_of(log_joint(means), "ascending"), mixture(means, ORDERED)
    with pytest.warns(EvidenceWarning, match="not normalised"):
        assert evidences(idata, model, "bridge")["bridge"].improper == "mu"
    with pytest.raises(ModelError, match="exchange leaves the density as it is"):
        evidences(idata, model, exchangeable="mu")


@pytest.mark.parametrize(
    ("exchangeable", "message"),
    [("nu", r"free variables of the model, \['mu', 'w'\], got \['nu'\]"),
     (3, r"free variables of the model, \['mu', 'w'\], got \[3\]"),
     (["w"], "must name a vector, or a tuple of scalars"),
     (("w", "w"), r"a tuple of scalars in a list, as \[\('low', 'high'\)\]"),
     (["mu", ("w", "w", "w")], "must name a vector, or a tuple of scalars")],
)  # fmt: skip
def test_bad_declarations(exchangeable, message):
    with mixture() as model:
        pm.Beta("w", 2, 2)
    idata = tree(mu=np.zeros((2, 20, 2)), w=np.full((2, 20), 0.5))
    with pytest.raises(ModelError, match=message):
        OneOrder(exchangeable, ModelDensity(model), idata, np.random.default_rng(1))


def check(model, idata, names, count, exchangeable):
    """Undeclared labels are those with these names, and may be declared as the message says."""
    density, rng = ModelDensity(model), np.random.default_rng(9)
    found = [one for one in undeclared_labels(density, idata, rng) if not one.endswith("noise")]
    if not names:
        assert not found
        return
    (message,) = found
    assert f"the {count} labels of {names} may be exchanged" in message
    assert f"give exchangeable={exchangeable}," in message
    labels = OneOrder(exchangeable, density, idata, rng).labels
    assert labels.log_orders == pytest.approx(np.log(np.arange(1, count + 1)).sum())


@pytest.mark.parametrize("of_second", [0.0, 0.5])
def test_a_share_is_that_of_the_other_label_in_exchange(of_second):
    """Of a mixture with the weights w and 1 - w; without symmetry it has no labels."""
    rng, shape = np.random.default_rng(4), (2, 200)
    means = {"first": -2.0, "second": 2.0}
    draws = {name: mean + 0.3 * rng.standard_normal(shape) for name, mean in means.items()}
    with pm.Model() as model:
        first, second = (pm.Normal(name, 0, 3) for name in means)
        w = pm.Beta("w", 2, 2)
        of_each = [
            pt.log(weight) + pm.logp(pm.Normal.dist(mean, 1), DATA)
            for weight, mean in ((w, first), (1 - w + of_second, second))
        ]
        pm.Potential("likelihood", pt.logaddexp(*of_each).sum())
    names = "" if of_second else "first, second, w"
    check(model, tree(**draws, w=rng.beta(8, 4, shape)), names, 2, ["w", ("first", "second")])


def test_three_labels_of_which_two_change_places():
    rng = np.random.default_rng(3)
    mu = np.array([-5.0, 5.0, 5.1]) + 0.3 * rng.standard_normal((2, 500, 3))
    with pm.Model() as model:
        mean = pm.Normal("mu", 0, 5, shape=3)
        pm.Potential("likelihood", pt.prod(mean) * 1e-3)
    check(model, tree(mu=mu), "mu", 3, ["mu"])


@pytest.mark.parametrize("one", [2, 1])
def test_two_of_three_labels_alone_may_not_be_exchanged(one):
    """Neighbours, or the first and the last."""
    mu = np.random.default_rng(3).standard_normal((2, 50, 3))
    with pm.Model() as model:
        mean = pm.Normal("mu", 0, 5, shape=3)
        pm.Potential("likelihood", mean[0] * mean[3 - one] + mean[one])
    check(model, tree(mu=mu), "", 3, None)


def test_a_matrix_is_permuted_along_its_axes():
    labels = Labels(2, {"P": (0, 1), "mean": (1,), "w": ()}, (("low", "high"),))
    values = {"P": np.array([[[1.0, 2.0], [3.0, 4.0]]] * 2), "mean": np.ones((2, 3, 2)).cumsum(2)}
    values |= {"w": np.array([0.3, 0.3]), "low": np.zeros(2), "high": np.ones(2)}
    found = labels.permuted(values, np.array([[1, 0], [0, 1]]))
    np.testing.assert_array_equal(found["P"], [[[4, 3], [2, 1]], [[1, 2], [3, 4]]])
    np.testing.assert_array_equal(found["mean"], [[[2, 1]] * 3, [[1, 2]] * 3])
    np.testing.assert_allclose(found["w"], [0.7, 0.3])
    np.testing.assert_array_equal([found["low"], found["high"]], [[1, 0], [0, 1]])
    np.testing.assert_array_equal(labels.of_labels("P", found), [[4, 1], [1, 4]])
    np.testing.assert_array_equal(labels.of_labels("mean", found), [[2, 1], [1, 2]])


def regimes(filter):
    """A hidden Markov model, whose matrix has the labels along both axes, and draws near truth."""

    def at(values, x):
        return values[pt.cast(x, "int64")]

    system = psf.StateSpaceModel(
        transition=lambda x, q: [q[0]],
        process_dist=lambda x, P: [pm.Categorical.dist(at(P, x[0]))],
        observation_dist=lambda x, mean, noise: [pm.Normal.dist(at(mean, x[0]), noise[0])],
        initial_dist=lambda P: [pm.Categorical.dist(psf.system.stationary(P))],
        shapes={"P": (2, 2), "mean": (2,), "noise": (2,)},
    )
    rng = np.random.default_rng(1)
    y = 2.0 * (np.cumsum(rng.random(30) < 0.15) % 2) + 0.5 * rng.standard_normal(30)
    with pm.Model() as model:
        pm.Dirichlet("P", np.array([[9.0, 1.0], [1.0, 9.0]]))
        pm.Normal("mean", 0, 5, shape=2)
        pm.HalfNormal("noise", 1, shape=2)  # of the same length, and no labels
        psf.StateSpace("d", system, filter, steps=range(30), observed=y)
    rng = np.random.default_rng(4)
    stay = rng.beta(20, 3, (2, 100, 2))
    P = np.stack([stay, 1 - stay], axis=-1)
    P[:, :, 1] = P[:, :, 1, ::-1]
    mean = [0.0, 2.0] + 0.1 * rng.standard_normal((2, 100, 2))
    return model, tree(P=P, mean=mean, noise=rng.uniform(0.4, 0.6, (2, 100, 2)))


@pytest.mark.parametrize("filter", [psf.FiniteStateFilter(), psf.BootstrapPF(200)])
def test_the_labels_of_regimes_are_found_in_both_axes_of_their_matrix(filter):
    model, idata = regimes(filter)
    check(model, idata, "P, mean", 2, ["P", "mean"])
    rng = np.random.default_rng(5)
    labels = OneOrder(["P", "mean"], ModelDensity(model), idata, rng).labels
    assert labels.axes == {"P": (0, 1), "mean": (0,)}


def test_sorted_draws_have_the_density_that_they_had():
    model, idata = regimes(psf.FiniteStateFilter())
    in_order = unconstrained_draws(idata, model)
    P, mean = (idata["posterior"][name].values.copy() for name in ("P", "mean"))
    P[:, ::2], mean[:, ::2] = P[:, ::2, ::-1, ::-1], mean[:, ::2, ::-1]
    exchanged = tree(P=P, mean=mean, noise=idata["posterior"]["noise"].values)
    density, rng = ModelDensity(model), np.random.default_rng(6)
    x = unconstrained_draws(exchanged, model)
    before = density.evaluate(x.reshape(200, -1)).reshape(2, 100)
    posterior = Posterior(x, before, lambda x, rng: density.evaluate(x))
    one_order = OneOrder(["P", "mean"], density, exchanged, rng)
    found = one_order.restricted(one_order.sorted_draws(posterior))
    np.testing.assert_allclose(found.draws, in_order, atol=1e-9)
    after = found.evaluate(found.draws.reshape(200, -1), rng).reshape(2, 100)
    np.testing.assert_allclose(after, before, rtol=1e-9)
    assert np.isneginf(found.evaluate(x[:, ::2].reshape(100, -1), rng)).all()


def test_labels_of_scalars_are_found():
    """Two states whose means and probabilities to leave are scalars, and two sensors beside them.

    Draws stay in one order of the states, and the sensors are no labels.
    """
    rng = np.random.default_rng(7)
    with pm.Model() as model:
        low, high = (pm.Normal(name, 0, 5) for name in ("low", "high"))
        up, down = (pm.Beta(name, 1, 9) for name in ("up", "down"))
        first, second = (pm.HalfNormal(name, 1) for name in ("first", "second"))
        share = down / (up + down)
        parts = [
            pt.log(share) + pm.logp(pm.Normal.dist(low, first), DATA),
            pt.log(1 - share) + pm.logp(pm.Normal.dist(high, first), DATA),
        ]
        pm.Potential("likelihood", pt.logaddexp(*parts).sum() - second)
    centres = {"low": -2.0, "high": 2.0, "up": 0.1, "down": 0.15, "first": 0.9, "second": 0.5}
    draws = {name: at + 0.02 * rng.standard_normal((2, 100)) for name, at in centres.items()}
    check(model, tree(**draws), "down, high, low, up", 2, [("low", "high"), ("up", "down")])


def test_three_scalars_are_three_labels_and_no_pairs():
    rng = np.random.default_rng(8)
    with pm.Model() as model:
        means = [pm.Normal(f"mean_{k}", 0, 5) for k in range(3)]
        pm.Normal("other", 0, 5, shape=2)
        pm.Potential("likelihood", -pt.sum(pt.stack(means) ** 4) * 1e-3 + model["other"][0])
    draws = {f"mean_{k}": 3.0 * k + 0.1 * rng.standard_normal((2, 100)) for k in range(3)}
    draws["other"] = rng.standard_normal((2, 100, 2))
    names = ("mean_0", "mean_1", "mean_2")
    check(model, tree(**draws), ", ".join(names), 3, [names])
