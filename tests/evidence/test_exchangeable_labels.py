"""An evidence from draws that stay in one order of exchangeable labels lacks ln K!, and says so."""

import warnings

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
import xarray as xr
from scipy.special import logsumexp
from scipy.stats import norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import EvidenceWarning
from pymc_statespace_filters.evidence.exchangeable_labels import (
    Axis,
    Share,
    _features,
    _log_visited,
    exchangeable_labels,
)

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
    return xr.DataTree.from_dict(
        {"posterior": xr.Dataset({"mu": (("chain", "draw", "k"), means.reshape(4, 800, 2))})}
    )


def mixture(prior_means=(0.0, 0.0), transform=None, orders=1):
    with pm.Model() as model:
        settings = {} if transform is None else {"transform": transform, "initval": [-1.0, 1.0]}
        mu = pm.Normal("mu", np.array(prior_means), 3, shape=2, **settings)
        of_each = [pm.logp(pm.Normal.dist(mu[k], 1), DATA) - np.log(2) for k in range(2)]
        pm.Potential("likelihood", pt.logaddexp(*of_each).sum())
        if orders > 1:
            pm.Potential("orders", pm.math.log(float(orders)))
    return model


def evidences(idata, model, *estimators):
    return psf.estimate_evidence(
        idata, model, estimators=estimators or None, random_seed=2, progressbar=False
    )


@pytest.mark.parametrize("transform", [None, ORDERED])
def test_one_order_lacks_ln_2_in_two_estimators_and_both_say_so(transform):
    idata = draws_of(log_joint(), "ascending")
    with pytest.warns(EvidenceWarning, match=r"2 labels of mu .* lacks ln 2 = 0\.693") as caught:
        found = evidences(idata, mixture(transform=transform))
    assert len(caught) == 1
    assert found.agreement
    for one in found.values():
        assert one.log_evidence + np.log(2) == pytest.approx(TRUTH, abs=4 * one.se + 1e-3)
        assert "labels of mu" in one.doubts
        assert one.improper == ""


def test_the_potential_of_the_message_counts_the_orders():
    idata = draws_of(log_joint(), "ascending")
    for one in evidences(idata, mixture(transform=ORDERED, orders=2)).values():
        assert one.log_evidence == pytest.approx(TRUTH, abs=4 * one.se + 1e-3)
        assert one.doubts == ""


def test_no_alarm_where_the_draws_visit_both_orders():
    found = evidences(draws_of(log_joint()), mixture(), "importance")["importance"]
    assert found.log_evidence == pytest.approx(TRUTH, abs=4 * found.se + 1e-3)


def test_no_alarm_without_symmetry():
    means = (-1.0, 1.5)
    truth = logsumexp(log_joint(means)) + 2 * np.log(WIDTH)
    found = evidences(draws_of(log_joint(means)), mixture(means), "importance")["importance"]
    assert found.log_evidence == pytest.approx(truth, abs=4 * found.se + 1e-3)


def test_an_order_that_is_half_of_an_asymmetric_prior_is_improper():
    idata = draws_of(log_joint((-1.0, 1.5)), "ascending")
    with pytest.warns(EvidenceWarning, match="not normalised"):
        assert evidences(idata, mixture((-1.0, 1.5), ORDERED), "bridge")["bridge"].improper == "mu"


@pytest.mark.parametrize("of_second", [0.0, 0.5])
def test_a_share_is_that_of_the_other_label_in_exchange(of_second):
    """Of a mixture with the weights w and 1 - w; without symmetry it has no labels."""
    rng, shape = np.random.default_rng(4), (2, 200)
    names = {"first": -2.0, "second": 2.0}
    draws = {
        name: (("chain", "draw"), mean + 0.3 * rng.standard_normal(shape))
        for name, mean in names.items()
    }
    draws["w"] = (("chain", "draw"), rng.beta(8, 4, shape))
    idata = xr.DataTree.from_dict({"posterior": xr.Dataset(draws)})
    with pm.Model() as model:
        means = [pm.Normal(name, 0, 3) for name in names]
        w = pm.Beta("w", 2, 2)
        weights = [w, 1 - w + of_second]
        of_each = [
            pt.log(weight) + pm.logp(pm.Normal.dist(mean, 1), DATA)
            for weight, mean in zip(weights, means, strict=True)
        ]
        pm.Potential("likelihood", pt.logaddexp(*of_each).sum())
    found = exchangeable_labels(model, idata, np.zeros(shape), rng)
    if of_second:
        assert not found
    else:
        (labels,) = found
        assert labels.names == ["first", "second", "w"]
        assert labels.lacking == pytest.approx(np.log(2))


def test_three_labels_of_which_two_change_places():
    rng = np.random.default_rng(3)
    mu = np.array([-5.0, 5.0, 5.1]) + 0.3 * rng.standard_normal((2, 500, 3))
    idata = xr.DataTree.from_dict({"posterior": xr.Dataset({"mu": (("chain", "draw", "k"), mu)})})
    with pm.Model() as model:
        mean = pm.Normal("mu", 0, 5, shape=3)
        pm.Potential("likelihood", pt.prod(mean) * 1e-3)
    (labels,) = exchangeable_labels(model, idata, np.zeros((2, 500)), rng)
    assert labels.lacking == pytest.approx(np.log(3))


def test_labels_that_change_places_in_pairs_visit_four_orders():
    of_labels = np.array([-5.0, -5.1, 5.0, 5.1]) + 0.3 * np.random.default_rng(3).normal(
        size=(800, 4)
    )
    assert _log_visited(of_labels[:, :, None], 0) == pytest.approx(np.log(4))


@pytest.mark.parametrize("one", [2, 1])
def test_two_of_three_labels_alone_may_not_be_exchanged(one):
    """Neighbours, or the first and the last."""
    rng = np.random.default_rng(3)
    mu = rng.standard_normal((2, 50, 3))
    idata = xr.DataTree.from_dict({"posterior": xr.Dataset({"mu": (("chain", "draw", "k"), mu)})})
    with pm.Model() as model:
        mean = pm.Normal("mu", 0, 5, shape=3)
        pm.Potential("likelihood", mean[0] * mean[3 - one] + mean[one])
    assert not exchangeable_labels(model, idata, np.zeros((2, 50)), rng)


def test_a_share_says_of_the_other_label_what_is_left():
    found = _features({"w": np.array([0.2, 0.9])}, [Share("w")])
    np.testing.assert_allclose(found, [[[0.2], [0.8]], [[0.9], [0.1]]])


def test_a_matrix_says_of_a_label_what_is_on_its_diagonal():
    draws = {"P": np.arange(8.0).reshape(2, 2, 2), "mean": np.array([[8.0, 9.0], [10.0, 11.0]])}
    found = _features(draws, [Axis("P", 0), Axis("P", 1), Axis("mean", 0)])
    np.testing.assert_array_equal(found, [[[0, 8], [3, 9]], [[4, 10], [7, 11]]])


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
    dims = ("chain", "draw")
    draws = {
        "P": ((*dims, "i", "j"), P),
        "mean": ((*dims, "i"), [0.0, 2.0] + 0.1 * rng.standard_normal((2, 100, 2))),
        "noise": ((*dims, "i"), rng.uniform(0.4, 0.6, (2, 100, 2))),
    }
    return model, xr.DataTree.from_dict({"posterior": xr.Dataset(draws)}), rng


@pytest.mark.parametrize("filter", [psf.FiniteStateFilter(), psf.BootstrapPF(200)])
def test_the_labels_of_regimes_are_found_in_both_axes_of_their_matrix(filter):
    model, idata, rng = regimes(filter)
    found = exchangeable_labels(model, idata, np.zeros((2, 100)), rng)
    (labels,) = [one for one in found if one.names != ["noise"]]
    assert labels.names == ["P", "mean"]
    assert len(labels.places) == 3
    assert labels.lacking == pytest.approx(np.log(2))
    assert all(one.lacking == 0.0 for one in found if one is not labels)


def test_nothing_is_evaluated_without_an_axis_of_labels():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pm.Model() as model:
            pm.Normal("mu", 0, 1)
        values = np.random.default_rng(5).standard_normal((2, 100))
        idata = xr.DataTree.from_dict(
            {"posterior": xr.Dataset({"mu": (("chain", "draw"), values)})}
        )
        assert exchangeable_labels(model, idata, values, np.random.default_rng(6)) == []


def scalar_labels(rng):
    """Two states whose means and probabilities to leave are scalars, and two sensors beside them.

    Draws stay in one order of the states, and the sensors are no labels.
    """
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
    draws = {
        name: (("chain", "draw"), centre + 0.02 * rng.standard_normal((2, 100)))
        for name, centre in centres.items()
    }
    return model, xr.DataTree.from_dict({"posterior": xr.Dataset(draws)})


def test_labels_of_scalars_are_found():
    rng = np.random.default_rng(7)
    model, idata = scalar_labels(rng)
    (labels,) = exchangeable_labels(model, idata, np.zeros((2, 100)), rng)
    assert sorted(labels.names) == ["down", "high", "low", "up"]
    assert labels.lacking == pytest.approx(np.log(2))


def test_three_scalars_are_three_labels_and_no_pairs():
    rng = np.random.default_rng(8)
    with pm.Model() as model:
        means = [pm.Normal(f"mean_{k}", 0, 5) for k in range(3)]
        pm.Normal("other", 0, 5, shape=2)
        pm.Potential("likelihood", -pt.sum(pt.stack(means) ** 4) * 1e-3 + model["other"][0])
    draws = {
        f"mean_{k}": (("chain", "draw"), 3.0 * k + 0.1 * rng.standard_normal((2, 100)))
        for k in range(3)
    }
    draws["other"] = (("chain", "draw", "i"), rng.standard_normal((2, 100, 2)))
    idata = xr.DataTree.from_dict({"posterior": xr.Dataset(draws)})
    (labels,) = exchangeable_labels(model, idata, np.zeros((2, 100)), rng)
    assert labels.names == ["mean_0", "mean_1", "mean_2"]
    assert labels.lacking == pytest.approx(np.log(6))
