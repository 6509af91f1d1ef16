"""Relevance of coefficients against a regression whose evidence is known."""

import numpy as np
import pandas as pd
import pymc as pm
import pytest
import xarray as xr
from scipy.optimize import minimize
from scipy.stats import multivariate_normal, norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import EvidenceWarning, ModelError
from pymc_statespace_filters.importance import normalised, systematic
from pymc_statespace_filters.terms.relevance import weighed
from pymc_statespace_filters.terms.relevance.table import _sentences
from tests.systems import FREE

N, SD, NAMES = 40, 0.5, ["b[0]", "b[1]", "b[2]"]
RNG = np.random.default_rng(8)
DESIGN = RNG.standard_normal((N, 3))
Y = DESIGN @ [0.6, 0.2, 0.0] + SD * RNG.standard_normal(N)
DATA = [1.9, 2.4, 0.2, 1.6, 2.3, 3.1, 1.0, -0.6, 0.9, 0.1, -1.7, -2.0]
PRIORS = {
    "normal": lambda: pm.Normal("b", [0.0, 0.1, 0.0], 1.5, shape=3),
    "flat": lambda: pm.Flat("b", shape=3),
    "uniform": lambda: pm.Uniform("b", -3, 4, shape=3),
    "laplace": lambda: pm.Laplace("b", 0, 1, shape=3),
}


def regression(prior="normal"):
    with pm.Model() as model:
        level = pm.Normal("level", 0, 1)
        pm.Normal("y", level + DESIGN @ PRIORS[prior](), SD, observed=Y)
    return model


def draws(model, n=4000, seed=1):
    """Posterior draws by importance resampling of the normal likelihood."""
    rng = np.random.default_rng(seed)
    design = np.column_stack([np.ones(N), DESIGN])
    cov = np.linalg.inv(design.T @ design / SD**2 + np.diag([1.0, 0, 0, 0]))
    x = rng.multivariate_normal(cov @ design.T @ Y / SD**2, cov, size=4 * n)
    own = pm.logp(model["b"], x[:, 1:]).eval().sum(axis=1)
    x = x[systematic(normalised(own), n, rng)]
    rng.shuffle(x)
    x = x.reshape(4, -1, 4)
    posterior = {"level": (("chain", "draw"), x[..., 0]), "b": (("chain", "draw", "i"), x[..., 1:])}
    return xr.DataTree.from_dict({"posterior": xr.Dataset(posterior)})


def exact_evidence(prior_sd):
    """With priors N(0, prior_sd^2) of the coefficients."""
    cov = SD**2 * np.eye(N) + np.ones((N, N)) + DESIGN @ np.diag(prior_sd**2) @ DESIGN.T
    return multivariate_normal(cov=cov).logpdf(Y)


def largest(kept):
    """The largest log-evidence with some coefficients, and their prior sds, from several starts."""

    def prior_sd(log_sd):
        found = np.zeros(3)
        found[kept] = np.exp(log_sd)
        return found

    runs = [
        minimize(lambda at: -exact_evidence(prior_sd(at)), np.full(len(kept), start), tol=1e-10)
        for start in (-1.0, 0.5)
    ]
    best = min(runs, key=lambda run: run.fun)
    return -best.fun, prior_sd(best.x)


@pytest.mark.parametrize("prior", PRIORS)
def test_a_regression_has_its_exact_optimum_under_any_prior_of_the_draws(prior):
    model = regression(prior)
    table = psf.relevance(draws(model), model, "b", random_seed=2, progressbar=False)
    assert list(table.index) == NAMES
    assert table.loc["b[2]", "prior_sd"] == table.loc["b[2]", "gain"] == 0.0
    evidence, prior_sd = largest([0, 1])
    assert abs(table.log_evidence - evidence) < 4 * table.log_evidence_se < 0.1
    np.testing.assert_allclose(table["prior_sd"], prior_sd, rtol=0.15)
    for j, name in enumerate(NAMES[:2]):
        gain = evidence - largest([1 - j])[0]
        assert abs(table.loc[name, "gain"] - gain) < 4 * table.loc[name, "gain_se"] < 0.5
    assert table.inclusion == {"b[0]": 0.5, "b[1]": 0.5, "b[2]": 0.0}


def test_moments_and_relevance_are_those_of_the_posterior():
    model = regression()
    table = psf.relevance(draws(model), model, ["b"], random_seed=3, progressbar=False)
    sd = table["prior_sd"].to_numpy()
    noise = SD**2 * np.eye(N) + np.ones((N, N))
    across = np.diag(sd**2) @ DESIGN.T @ np.linalg.inv(noise + DESIGN @ np.diag(sd**2) @ DESIGN.T)
    variance = sd**2 - np.diag(across @ DESIGN) * sd**2
    np.testing.assert_allclose(table["mean"], across @ Y, atol=0.01)
    np.testing.assert_allclose(table["sd"], np.sqrt(variance), rtol=0.1)
    expected = [1 - v / s**2 if s else 0.0 for v, s in zip(variance, sd, strict=True)]
    np.testing.assert_allclose(table["relevance"], expected, atol=0.02)


def test_a_subset_of_the_coefficients_leaves_the_other_priors():
    model = regression()
    table = psf.relevance(draws(model), model, ["b[2]"], random_seed=4, progressbar=False)
    cov = SD**2 * np.eye(N) + np.ones((N, N)) + 1.5**2 * DESIGN[:, :2] @ DESIGN[:, :2].T
    expected = multivariate_normal(0.1 * DESIGN[:, 1], cov).logpdf(Y)
    assert abs(table.log_evidence - expected) < 4 * table.log_evidence_se < 0.1


@pytest.mark.parametrize("filter", [psf.EKF(), psf.BootstrapPF(64)], ids=["exact", "noisy"])
def test_the_evidence_of_a_state_space_model_is_its_integral(filter):
    with pm.Model() as model:
        pm.Normal("a", 0, 1)
        psf.StateSpace("d", FREE, filter, steps=range(12), observed=DATA)
    grid = np.linspace(-3, 3, 601)
    params = {"a": grid}
    log_likelihood = psf.log_likelihood(FREE, psf.EKF(), params, DATA, steps=range(12)).sum(-1)
    weights = normalised(log_likelihood + norm.logpdf(grid))
    a = np.random.default_rng(5).choice(grid, p=weights, size=(4, 500))
    idata = xr.DataTree.from_dict({"posterior": xr.Dataset({"a": (("chain", "draw"), a)})})
    table = psf.relevance(idata, model, "a", random_seed=6, progressbar=False)
    sd = table.loc["a", "prior_sd"]
    integrand = np.exp(log_likelihood) * norm.pdf(grid, scale=sd)
    assert abs(table.log_evidence - np.log(integrand.sum() * 0.01)) < 4 * table.log_evidence_se
    gain = table.log_evidence - log_likelihood[300]
    assert abs(table.loc["a", "gain"] - gain) < 4 * table.loc["a", "gain_se"]
    assert table.log_evidence_se < 0.05


def test_a_gain_that_the_points_do_not_determine_is_unknown(monkeypatch):
    monkeypatch.setattr(weighed, "N_REFITS", 0)
    monkeypatch.setattr(weighed, "MIN_EFFECTIVE", 1900)
    model = regression()
    with pytest.warns(EvidenceWarning, match=r"without b\[0\]: .* effective points"):
        table = psf.relevance(draws(model), model, "b", random_seed=2, progressbar=False)
    assert np.isnan(table.loc["b[0]", "gain"])
    assert "b[0]: the normal mixture" in repr(table)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], "names must name at least one"),
        ("c", r"names must name free variables of the model, or elements of them, got 'c'"),
        ("half", "coefficients of either sign, got 'half' with values from 0 to inf"),
        ("joint", r"independent priors, got 'joint' with a joint prior \(MvNormal"),
        ("shrunk", r"prior depends on \['half'\]"),
    ],
)
def test_other_coefficients_are_refused(names, message):
    with pm.Model() as model:
        half = pm.HalfNormal("half")
        shrunk = pm.Normal("shrunk", 0, half)
        joint = pm.MvNormal("joint", np.zeros(2), np.eye(2))
        pm.Normal("y", half + shrunk + joint.sum(), observed=[0.3])
    with pytest.raises(ModelError, match=message):
        psf.relevance(draws(regression()), model, names)


def test_a_rival_of_a_term_in_doubt_stays_open():
    """Two coefficients of nearly the same design: the optimum has one, and names the other."""
    rng = np.random.default_rng(3)
    x = rng.standard_normal(N)
    twin = np.column_stack([x, x + 0.05 * rng.standard_normal(N)])
    observed = 0.5 * x + SD * rng.standard_normal(N)
    precision = twin.T @ twin / SD**2 + np.eye(2)
    mean = np.linalg.solve(precision, twin.T @ observed / SD**2)
    b = rng.multivariate_normal(mean, np.linalg.inv(precision), size=(4, 500))
    idata = xr.DataTree.from_dict({"posterior": xr.Dataset({"b": (("chain", "draw", "i"), b)})})
    with pm.Model() as model:
        pm.Normal("y", twin @ pm.Normal("b", 0, 1, shape=2), SD, observed=observed)
    table = psf.relevance(idata, model, "b", random_seed=1, progressbar=False)
    (present,) = table.index[table["prior_sd"] > 0]
    (absent,) = table.index[table["prior_sd"] == 0]
    assert table.loc[present, "rivals"] == absent
    assert table.loc[present, "gain"] < 6
    assert table.inclusion == {"b[0]": 0.5, "b[1]": 0.5}


def test_a_term_of_negative_gain_reads_as_irrelevant():
    columns = {"prior_sd": [1.0, 0.5, 0.0], "gain": [3.0, -0.2, 0.0], "doubts": ["", "", ""]}
    sentences = _sentences(pd.DataFrame(columns, index=["a", "b", "c"]), -10.0, 0.1)
    assert "Irrelevant: b, c." in sentences
