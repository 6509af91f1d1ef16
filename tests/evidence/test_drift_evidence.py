"""The Bayes factor for drift, against quadrature over the strength."""

from dataclasses import replace
from functools import cache

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.integrate import quad
from scipy.stats import halfnorm, norm, uniform

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import EvidenceWarning, ModelError
from pymc_statespace_filters.evidence.comparison.scaled_prior import ScaledPrior
from pymc_statespace_filters.evidence.drift.conditional import fit_conditional
from pymc_statespace_filters.evidence.drift.drift_evidence import _by_width, _table
from pymc_statespace_filters.evidence.drift.marginal import ConstantModel, fit_conditionals
from pymc_statespace_filters.evidence.drift.strengths import StrengthsAtPoints
from pymc_statespace_filters.evidence.posterior_of_draws import build_posterior, reproducing_seeds
from pymc_statespace_filters.pymc_model.density import ModelDensity
from pymc_statespace_filters.pymc_model.posterior_draws import BY_PARTICLES
from pymc_statespace_filters.statistics.importance import LogMean, log_mean_of_draws
from tests.systems import wandering_mean

N_ROWS, MEAN_SD, WIDTH = 12, 2.0, 0.5
SYSTEM = wandering_mean()
PATH_COV = np.minimum.outer(np.arange(N_ROWS), np.arange(N_ROWS))
EXACT = psf.EKF()
HALF_NORMAL = halfnorm(scale=WIDTH).pdf
QUIET = {"random_seed": 1, "progressbar": False}


def log_normal(observed, covs):
    """The log-density (...) of a record by normals of mean zero with covariances (..., T, T)."""
    solved = np.linalg.solve(covs, observed[:, None])[..., 0] @ observed
    return -0.5 * (solved + np.linalg.slogdet(2 * np.pi * covs)[1])


def log_likelihood(observed, strength):
    """With the mean integrated out; exact, for strengths (...)."""
    s = np.asarray(strength)[..., None, None]
    return log_normal(observed, np.eye(N_ROWS) + MEAN_SD**2 + s**2 * PATH_COV)


def record(strength, random_seed):
    rng = np.random.default_rng(random_seed)
    steps = strength * rng.standard_normal(N_ROWS - 1)
    return 1 + np.concatenate([[0], np.cumsum(steps)]) + rng.standard_normal(N_ROWS)


@cache
def drifting_model(strength, random_seed, filter=EXACT, prior="half-normal"):
    observed = record(strength, random_seed)
    with pm.Model() as model:
        pm.Normal("mu", 0, MEAN_SD)
        priors = {
            "half-normal": lambda: pm.HalfNormal("mu_strength", WIDTH),
            "uniform": lambda: pm.Uniform("mu_strength", 0, WIDTH),
            "signed": lambda: pm.Normal("mu_strength", 0, WIDTH),
        }
        priors[prior]()
        psf.StateSpace("d", SYSTEM, filter, steps=range(N_ROWS), observed=observed)
    return model, observed


def exact_log_bayes_factor(observed, density=HALF_NORMAL, largest=8 * WIDTH):
    shift = log_likelihood(observed, 0.0)
    drifting = quad(
        lambda s: density(s) * np.exp(log_likelihood(observed, s) - shift), 0, largest, limit=200
    )
    return np.log(drifting[0])


def on_grid(largest):
    """Middles of 2000 cells."""
    ends = np.linspace(0, largest, 2001)
    return (ends[1:] + ends[:-1]) / 2


def drawn_strengths(grid, log_posterior, n, rng):
    """Independent draws of a density on a grid."""
    weights = np.exp(log_posterior - np.max(log_posterior))
    s = rng.choice(grid, size=n, p=weights / weights.sum())
    return np.clip(s + (rng.random(n) - 0.5) * (grid[1] - grid[0]), 1e-9, None)


def drawn_means(observed, path_covs, rng):
    """Draws of the mean, each given the covariance (T, T) of the path, by conjugacy."""
    both = np.column_stack([np.ones(N_ROWS), observed])
    solved = np.linalg.solve(np.eye(N_ROWS) + path_covs, both).sum(axis=-2)
    precision = solved[..., 0] + MEAN_SD**-2
    return solved[..., 1] / precision + rng.standard_normal(solved.shape[:-1]) / np.sqrt(precision)


def exact_draws(observed, density, largest, n=(4, 1000), random_seed=3, signed=False):
    """Independent draws of strength and mean: by quadrature, and by conjugacy given it."""
    rng, grid = np.random.default_rng(random_seed), on_grid(largest)
    log_posterior = log_likelihood(observed, grid) + np.log(density(grid))
    s = drawn_strengths(grid, log_posterior, n, rng)
    mu = drawn_means(observed, s[..., None, None] ** 2 * PATH_COV, rng)
    if signed:
        s = s * rng.choice([-1, 1], size=n)
    return az.from_dict({"posterior": {"mu": mu, "mu_strength": s}})


PRIORS = {
    "half-normal": (HALF_NORMAL, 8 * WIDTH),
    "uniform": (uniform(0, WIDTH).pdf, WIDTH),
    "signed": (HALF_NORMAL, 8 * WIDTH),
}


@pytest.mark.parametrize(
    ("strength", "prior"), [(0.0, "half-normal"), (0.4, "uniform"), (0.4, "signed")]
)
def test_bayes_factor_is_that_of_quadrature(strength, prior):
    model, observed = drifting_model(strength, 1, prior=prior)
    density, largest = PRIORS[prior]
    idata = exact_draws(observed, density, largest, signed=prior == "signed")
    table = psf.drift_evidence(idata, model, var_names="mu_strength", **QUIET)
    row = table.loc["mu_strength"]
    exact = exact_log_bayes_factor(observed, density, largest)
    assert row["se"] < 0.05
    assert abs(row["log_bayes_factor"] - exact) < 3.5 * row["se"]
    np.testing.assert_allclose(row["prob"], 1 / (1 + np.exp(-row["log_bayes_factor"])))
    assert row["prob_low"] < row["prob"] < row["prob_high"]
    assert not row["doubts"]


def test_widths_are_those_of_quadrature():
    model, observed = drifting_model(0.0, 1)
    idata = exact_draws(observed, *PRIORS["half-normal"])
    widths = [0.5, 1.0, 2.0]
    found = psf.drift_evidence(idata, model, var_names=["mu_strength"], widths=widths, **QUIET)
    curve = found.widths.sel(model="drift, mu_strength")
    exact = [
        exact_log_bayes_factor(observed, halfnorm(scale=w * WIDTH).pdf, 8 * w * WIDTH)
        for w in widths
    ]
    error = curve["width_log_bayes_factor"] - exact
    assert (abs(error) < 3.5 * curve["width_se"]).all()
    assert (curve["width_se"] < 0.06).all()
    np.testing.assert_allclose(curve["width_prob"][1], found["prob"].iloc[0])
    psf.plot_prior_sensitivity(found.widths, backend="none")


def test_errors_of_the_curve_are_those_of_populations():
    """Whose draws alternate along the chains, where their means cancel."""
    model, observed = drifting_model(0.0, 1)
    idata = exact_draws(observed, *PRIORS["half-normal"])
    sizes = idata["posterior"].sizes
    shape = sizes["chain"], sizes["draw"]
    population = np.broadcast_to(np.arange(shape[1]) % 4, shape)
    rng = np.random.default_rng(1)
    terms = {("mu_strength",): 0.1 * population + 0.1 * rng.standard_normal(shape)}
    error = []
    for sampler in ("", BY_PARTICLES):
        idata.attrs["sampler"] = sampler
        stats = xr.Dataset({"population": (("chain", "draw"), population)})
        idata["sample_stats"] = xr.DataTree(stats)
        found = _by_width(model, idata, terms, np.array([1.0]), np.log([0.5] * 2), 0.95)
        error.append(float(found["width_se"].max()))
    assert error[1] > 10 * error[0] > 0


def test_errors_that_both_means_share_cancel_in_the_curve():
    """If the terms are the ratios of a width, the factor there is one without an error."""
    model, observed = drifting_model(0.0, 1)
    idata = exact_draws(observed, *PRIORS["half-normal"])
    draws = idata["posterior"].to_dataset()
    ratios, _ = ScaledPrior(model, ["mu_strength"]).log_ratios(draws, 0.5)
    terms = {("mu_strength",): ratios[..., 0]}
    found = _by_width(model, idata, terms, np.array([0.5, 1.0]), np.log([0.5] * 2), 0.95)
    for name in ("width_log_bayes_factor", "width_se"):
        assert abs(found[name].values[0, 0]) < 1e-12 < abs(found[name].values[0, 1])


def test_estimates_of_the_likelihood_give_the_exact_factor():
    model, observed = drifting_model(0.0, 1, psf.BootstrapPF(16))
    row = psf.drift_evidence(noisy_chains(), model, var_names="mu_strength", **QUIET).iloc[0]
    assert row["se"] < 0.1
    assert abs(row["log_bayes_factor"] - exact_log_bayes_factor(observed)) < 3.5 * row["se"]


def test_without_seeds_the_numerator_has_fresh_noise():
    model, observed = drifting_model(0.0, 1, psf.BootstrapPF(16))
    posterior, _ = build_posterior(noisy_chains(), ModelDensity(model))
    constant = ConstantModel(model, ["mu_strength"], moved=False)
    mean = log_mean_of_draws(constant.log_terms(posterior, None, np.random.default_rng(1)))
    assert mean.error < 0.15
    assert abs(-mean.value - exact_log_bayes_factor(observed)) < 3.5 * mean.error


def test_with_seeds_the_numerator_has_the_noise_of_the_draw(monkeypatch):
    model, _ = drifting_model(0.0, 1, psf.BootstrapPF(16))
    density, idata, given = ModelDensity(model), noisy_chains(), []
    constant = ConstantModel(model, ["mu_strength"], moved=False)

    def evaluate(x, seeds):
        given.append(seeds[:, 0])
        return np.zeros(len(x))

    monkeypatch.setattr(constant.density, "evaluate", evaluate)
    posterior, _ = build_posterior(idata, density)
    seeds = reproducing_seeds(idata, density)
    constant.log_terms(posterior, seeds, np.random.default_rng(1))
    stored = idata["sample_stats"]["d_seed"].values
    for found, half in zip(given, (stored[:, 1000:], stored[:, :1000]), strict=True):
        np.testing.assert_array_equal(found, half.ravel())


@cache
def noisy_chains():
    model, _ = drifting_model(0.0, 1, psf.BootstrapPF(16))
    return psf.sample_dram(2000, tune=1000, model=model, **QUIET)


def test_drift_beyond_doubt_has_no_error_and_says_what_to_do():
    model, observed = drifting_model(5.0, 2)
    idata = exact_draws(observed, *PRIORS["half-normal"], n=(2, 40))
    with pytest.warns(EvidenceWarning, match=r"pm.do\(model, \{'mu_strength': 0.0\}\)"):
        table = psf.drift_evidence(idata, model, var_names="mu_strength", **QUIET)
    row = table.iloc[0]
    assert np.isnan(row["se"])
    assert row["undecided"]
    assert row["prob"] > 0.99
    assert np.isnan(table.widths["width_prob"]).all()
    assert "unknown" in repr(table)


def test_models_whose_probabilities_are_equal_are_undecided():
    name, terms = ("s",), np.zeros((2, 10))
    for prior, undecided in ((0.5, True), (0.9, False)):
        weights = np.array([1 - prior, prior])
        table = _table({name: terms}, {name: LogMean(0.0, 0.1)}, {name: []}, weights, 0.95)
        assert table.loc["s", "prob"] == pytest.approx(prior)
        assert table.loc["s", "undecided"] == undecided


def test_several_strengths_alone_and_together():
    """Of independent records with drifts of their own the factors are products."""
    system = wandering_mean()
    records = [record(0.0, 1), record(0.4, 5)]
    with pm.Model() as model:
        for i, observed in enumerate(records):
            mu = pm.Normal(f"mu{i}", 0, MEAN_SD)
            s = pm.HalfNormal(f"s{i}", WIDTH)
            psf.StateSpace(
                f"d{i}", system, psf.EKF(), steps=range(N_ROWS), observed=observed,
                params={"mu": mu, "mu_strength": s},
            )  # fmt: skip
    draws = {}
    for i, observed in enumerate(records):
        found = exact_draws(observed, *PRIORS["half-normal"], random_seed=i)["posterior"]
        draws |= {f"mu{i}": found["mu"].values, f"s{i}": found["mu_strength"].values}
    idata = az.from_dict({"posterior": draws})
    prior = {"constant": 3, "drifting": 1}
    table = psf.drift_evidence(idata, model, var_names=["s0", "s1"], model_prior=prior, **QUIET)
    assert list(table.index)[2] == "s0, s1"
    assert table["prob"].iloc[0] > table["prob"].iloc[1]  # whatever the order of the names
    log_odds = table["log_bayes_factor"] - np.log(3)
    np.testing.assert_allclose(table["prob"], 1 / (1 + np.exp(-log_odds)))
    assert (table["undecided"] == (abs(log_odds) < norm.ppf(0.975) * table["se"])).all()
    curves = table.widths["width_prob"].sel(width=1.0)
    for name in table.index:
        np.testing.assert_allclose(curves.sel(model=f"drift, {name}"), table.loc[name, "prob"])
    exact = [exact_log_bayes_factor(observed) for observed in records]
    for name, value in zip(["s0", "s1", "s0, s1"], [*exact, sum(exact)], strict=True):
        row = table.loc[name]
        assert row["se"] < 0.07
        assert abs(row["log_bayes_factor"] - value) < 3.5 * row["se"]


def test_no_draw_is_weighed_by_what_it_has_taught():
    """The density w of a half of the chains is fitted to the other half, so that it is given."""
    model, observed = drifting_model(0.0, 1)
    idata = exact_draws(observed, *PRIORS["half-normal"], n=(2, 100))
    posterior, _ = build_posterior(idata, ModelDensity(model))
    draws = posterior.draws.copy()
    draws[0, 0] += 0.5
    constant = ConstantModel(model, ["mu_strength"], moved=False)
    before, after = (
        constant.log_terms(one, None, np.random.default_rng(1))
        for one in (posterior, replace(posterior, draws=draws))
    )
    is_same = before == after
    assert np.argwhere(~is_same[:, :50]).tolist() == [[0, 0]]
    assert not is_same[:, 50:].any()


def test_bounded_variables_without_a_transform_are_not_translated():
    """What they are translated to may be outside the support, and lost to the mean."""
    with pm.Model() as model:
        for name, transform in (("a", {}), ("b", {"default_transform": None})):
            pm.Uniform(name, 0, 1, **transform)
        s = pm.HalfNormal("s", 1)
        pm.Normal("y", model["a"] + model["b"], 1 + s, observed=[0.1, 0.8])
    rng = np.random.default_rng(1)
    size = np.abs(rng.standard_normal((200, 1)))
    constant = ConstantModel(model, ["s"], moved=False)
    strengths = constant._strengths(np.column_stack([rng.random((200, 2)), np.log(size)]))
    fit = fit_conditionals(strengths, size + rng.random((200, 2)), constant._is_bounded)
    is_a = constant._others == 0  # the constant model has an order of its own
    np.testing.assert_array_equal(fit.translation != 0.0, [is_a, is_a])
    moved = fit.translated(strengths.sizes, size + rng.random((200, 2)))
    assert abs(np.corrcoef(size[:, 0], moved[:, is_a][:, 0])[0, 1]) < 0.3  # 0.9 before


@pytest.mark.parametrize("largest", [np.inf, 1.5])
def test_density_of_a_strength_integrates_to_one(largest):
    rng = np.random.default_rng(1)
    given, s = rng.standard_normal((500, 2)), np.abs(rng.standard_normal(500))
    fitted = fit_conditional(s[s < largest], given[s < largest], largest)

    def density(s):
        return np.exp(fitted.log_density(np.array([s]), given[:1])).item()

    np.testing.assert_allclose(quad(density, 0, largest)[0], 1, rtol=1e-6)


def test_fitted_density_of_a_strength_follows_the_other_parameters():
    rng = np.random.default_rng(1)
    given = rng.standard_normal((4000, 2))
    s = np.abs(rng.standard_normal(4000)) * np.exp(0.3 * given[:, 0])
    fitted = fit_conditional(s, given)
    # s squared has the mean exp(0.6 z) and the distribution of a squared normal
    np.testing.assert_allclose(fitted.coefficients, [0, 0.6, 0], atol=0.12)
    assert fitted.shape == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("shared", [True, False])
def test_records_of_a_panel_with_one_strength_or_their_own(shared):
    """A vector of strengths is zero as a whole: of independent records the factors multiply."""
    records, rng = [record(0.0, 1), record(0.4, 5)], np.random.default_rng(7)
    with pm.Model() as model:
        pm.Normal("mu", 0, MEAN_SD, shape=2)
        pm.HalfNormal("mu_strength", WIDTH, shape=() if shared else 2)
        psf.StateSpace(
            "d", SYSTEM, psf.EKF(), panel=np.repeat(["a", "b"], N_ROWS),
            steps=np.tile(np.arange(N_ROWS), 2), observed=np.concatenate(records),
        )  # fmt: skip
    grid = on_grid(8 * WIDTH)
    logs = np.array([log_likelihood(d, grid) - log_likelihood(d, 0.0) for d in records])
    log_prior = np.log(HALF_NORMAL(grid) * (grid[1] - grid[0]))
    logs = logs.sum(axis=0, keepdims=True) if shared else logs
    exact = np.log(np.exp(logs + log_prior).sum(axis=1)).sum()
    s = np.stack([drawn_strengths(grid, one + log_prior, (4, 1000), rng) for one in logs], -1)
    covs = np.broadcast_to(s, (4, 1000, 2))[..., None, None] ** 2 * PATH_COV
    mu = np.stack([drawn_means(records[i], covs[:, :, i], rng) for i in (0, 1)], -1)
    idata = az.from_dict({"posterior": {"mu": mu, "mu_strength": s[..., 0] if shared else s}})
    row = psf.drift_evidence(idata, model, var_names="mu_strength", **QUIET).loc["mu_strength"]
    assert row["se"] < 0.1
    assert abs(row["log_bayes_factor"] - exact) < 3.5 * row["se"]


def constant_mean():
    """A constant mean with unit noise of the sensor; the mean may drift."""
    return psf.StateSpaceModel(
        transition=lambda x, q: [0.0 * x[0]],
        process_noise=[[1.0]],
        observation=lambda x, mu: [mu + x[0]],
        observation_noise=[[1.0]],
        initial_mean=[0.0],
        initial_cov=[[0.0]],
    )


def returning_cov(strength, rate):
    """Of a path that returns to where it begins: covariances (..., T, T)."""
    s, r, k = (
        np.asarray(strength)[..., None, None],
        np.asarray(rate)[..., None, None],
        np.arange(N_ROWS),
    )
    apart, both = abs(np.subtract.outer(k, k)), np.add.outer(k, k)
    return s**2 / (2 * r) * (np.exp(-r * apart) - np.exp(-r * both))


def test_without_strength_the_rate_of_return_has_no_influence():
    """Against quadrature over strength and rate; the constant model has the mean alone."""
    observed, rng = record(0.4, 5), np.random.default_rng(7)
    returning = psf.drifting(constant_mean(), mu=psf.OrnsteinUhlenbeck())
    with pm.Model() as model:
        pm.Normal("mu", 0, MEAN_SD)
        pm.HalfNormal("mu_strength", WIDTH)
        pm.LogNormal("mu_rate", np.log(0.3), 1)
        psf.StateSpace("d", returning, psf.EKF(), steps=range(N_ROWS), observed=observed)
    s, z = np.meshgrid(np.linspace(0, 4 * WIDTH, 121)[1:] - WIDTH / 60, np.linspace(-4, 4, 81))
    rate = 0.3 * np.exp(z)
    log_l = log_normal(observed, returning_cov(s, rate) + np.eye(N_ROWS) + MEAN_SD**2)
    log_prior = halfnorm.logpdf(s, scale=WIDTH) + norm.logpdf(z)
    joint = np.exp(log_l - log_likelihood(observed, 0.0) + log_prior) * WIDTH / 30 * 0.1
    chosen = rng.choice(s.size, size=(4, 1000), p=joint.ravel() / joint.sum())
    cell = rng.random((2, 4, 1000)) - 0.5
    s, z = s.ravel()[chosen] + cell[0] * WIDTH / 30, z.ravel()[chosen] + cell[1] * 0.1
    rate = 0.3 * np.exp(z)
    mu = drawn_means(observed, returning_cov(s, rate), rng)
    idata = az.from_dict({"posterior": {"mu": mu, "mu_strength": s, "mu_rate": rate}})
    row = psf.drift_evidence(idata, model, **QUIET).loc["mu_strength"]
    assert row["se"] < 0.1
    assert abs(row["log_bayes_factor"] - np.log(joint.sum())) < 3.5 * row["se"]


def test_strengths_of_a_drifting_system_are_found():
    observed = record(0.4, 5)
    drifting = psf.drifting(constant_mean(), mu=psf.RandomWalk())
    with pm.Model() as model:
        pm.Normal("mu", 0, MEAN_SD)
        width = pm.HalfNormal("width", WIDTH)
        psf.StateSpace(
            "d", drifting, psf.EKF(), steps=range(N_ROWS), observed=observed,
            params={"mu_strength": width},
        )  # fmt: skip
    draws = exact_draws(observed, *PRIORS["half-normal"])
    draws["posterior"] = draws["posterior"].to_dataset().rename(mu_strength="width")
    row = psf.drift_evidence(draws, model, **QUIET).loc["width"]
    exact = exact_log_bayes_factor(observed)
    assert abs(row["log_bayes_factor"] - exact) < 3.5 * row["se"]
    with pytest.raises(ModelError, match="no system of the model is made by"):
        psf.drift_evidence(draws, drifting_model(0.0, 1)[0])


def test_bad_arguments():
    model, observed = drifting_model(0.0, 1)
    idata = exact_draws(observed, *PRIORS["half-normal"], n=(2, 50))
    with pytest.raises(ModelError, match=r"var_names.*\['mu', 'mu_strength'\], got \['s'\]"):
        psf.drift_evidence(idata, model, var_names="s")
    with pytest.raises(ModelError, match="model_prior"):
        psf.drift_evidence(idata, model, var_names="mu_strength", model_prior={"constant": 1})
    with pm.Model() as other:
        pm.Normal("mu", 0, 1)
        pm.LogNormal("flat", 0, 1)
        pm.HalfFlat("s")
        pm.Uniform("u", 0.1, 1)
        pm.Normal("y", 0, 1, observed=[0.0])
    with pytest.raises(ModelError, match="prior of 's' is improper"):
        psf.drift_evidence(idata, other, var_names="s")
    with pytest.raises(ModelError, match="support of 'u' must begin at zero"):
        StrengthsAtPoints(other, ["u"])


@pytest.mark.parametrize(
    ("prior", "is_signed", "largest"),
    [(lambda: pm.Beta("s", 1, 3), False, 1.0), (lambda: pm.HalfNormal("s"), False, np.inf),
     (lambda: pm.Uniform("s", -2, 2), True, 2.0), (lambda: pm.Normal("s"), True, np.inf)],
)  # fmt: skip
def test_a_strength_is_signed_if_its_support_reaches_below_zero(prior, is_signed, largest):
    with pm.Model() as model:
        prior()
    found = StrengthsAtPoints(model, ["s"])(np.zeros((1, 1)))
    assert (found.is_signed.item(), found.largest.item()) == (is_signed, largest)
