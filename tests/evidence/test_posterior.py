"""From draws in a DataTree to the unconstrained space of their model."""

import math
import re

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.evidence import chib_jeliazkov
from pymc_statespace_filters.evidence.checks import check_convergence
from pymc_statespace_filters.evidence.posterior import Posterior
from pymc_statespace_filters.evidence.posterior_of_draws import build_posterior
from pymc_statespace_filters.pymc_model.density import ModelDensity
from pymc_statespace_filters.pymc_model.posterior_draws import unconstrained_draws
from pymc_statespace_filters.pymc_model.prior import ModelPrior
from tests.modes import AS_IT_STANDS

DATA = np.array([0.3, 1.2, 0.8])


@pytest.fixture(scope="module")
def model():
    """No transform, log, an interval with a free bound, a simplex; scalars, a vector, a matrix."""
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 1)
        upper = pm.HalfNormal("upper", 1)
        sd = pm.Uniform("sd", 0, upper)
        w = pm.Dirichlet("w", np.ones(3))
        pm.Normal("matrix", 0, 1, shape=(2, 2))
        pm.Normal("y", mu + w[0], sd, observed=DATA)
    return model


@pytest.fixture(scope="module")
def density(model):
    return ModelDensity(model)


@pytest.fixture
def idata(model):
    rng = np.random.default_rng(1)
    shape = (2, 30)
    upper = np.abs(rng.standard_normal(shape))
    return az.from_dict(
        {
            "posterior": {
                "mu": rng.standard_normal(shape),
                "upper": upper,
                "sd": upper * rng.uniform(size=shape),
                "w": rng.dirichlet(np.ones(3), size=shape),
                "matrix": rng.standard_normal((*shape, 2, 2)),
            }
        }
    )


def test_unconstrained_draws_follow_the_transforms(idata, model):
    draws = unconstrained_draws(idata, model)
    posterior = idata["posterior"]
    assert draws.shape == (2, 30, 1 + 1 + 1 + 2 + 4)
    np.testing.assert_array_equal(draws[..., 0], posterior["mu"])
    np.testing.assert_allclose(draws[..., 1], np.log(posterior["upper"]))
    share = (posterior["sd"] / posterior["upper"]).values
    np.testing.assert_allclose(draws[..., 2], np.log(share) - np.log1p(-share), rtol=1e-9)
    np.testing.assert_array_equal(draws[..., 5:], posterior["matrix"].values.reshape(2, 30, 4))


def test_log_density_is_that_of_the_model_with_jacobians(idata, model, density):
    posterior, noise = build_posterior(idata, density)
    names = [model.rvs_to_values[rv].name for rv in model.free_RVs]
    x = posterior.draws[1, 7]
    parts = np.split(x, np.cumsum([1, 1, 1, 2]))
    point = dict(
        zip(names, [*(p[0] for p in parts[:3]), parts[3], parts[4].reshape(2, 2)], strict=True)
    )
    expected = model.compile_logp(mode=AS_IT_STANDS)(point)
    assert noise == "none"
    assert posterior.log_density[1, 7] == pytest.approx(expected, rel=1e-12)
    assert posterior.evaluate(x[None], np.random.default_rng(0))[0] == pytest.approx(expected)
    likelihood = model.compile_logp(vars=model.observed_RVs, mode=AS_IT_STANDS)(point)
    assert expected - ModelPrior(density.model).log_density(x[None])[0] == pytest.approx(likelihood)


def test_no_density_is_minus_infinity_never_nan(density):
    x = np.full((1, 9), np.nan)
    assert density.evaluate(x, np.empty((1, 0), dtype=np.int64))[0] == -np.inf


def test_missing_variables_are_named(idata, model):
    idata["posterior"] = idata["posterior"].to_dataset().drop_vars(["w", "mu"])
    with pytest.raises(DataMismatchError, match=r"\['mu', 'w'\].*'matrix', 'sd', 'upper'"):
        unconstrained_draws(idata, model)


def test_wrong_shape(idata, model):
    idata["posterior"] = idata["posterior"].to_dataset().isel(w_dim_0=slice(2))
    with pytest.raises(
        DataMismatchError, match=r"'w' in idata must have the model's shape \(3,\), got \(2,\)"
    ):
        unconstrained_draws(idata, model)


def test_draws_outside_the_support(idata, model):
    dataset = idata["posterior"].to_dataset()
    dataset["upper"] = -dataset["upper"]
    idata["posterior"] = dataset
    with pytest.raises(DataMismatchError, match="got 60 of 60 draws outside"):
        unconstrained_draws(idata, model)


def test_no_posterior_group(model):
    with pytest.raises(ModelError, match="group 'posterior'"):
        unconstrained_draws(az.from_dict({"prior": {"mu": np.zeros((1, 30))}}), model)


def test_too_few_draws(idata, model):
    idata["posterior"] = idata["posterior"].to_dataset().isel(draw=slice(5))
    with pytest.raises(ModelError, match="at least 20 draws per chain, got 5"):
        unconstrained_draws(idata, model)


def test_discrete_variables_are_refused():
    with pm.Model() as model:
        count = pm.Poisson("count", 3)
        pm.Normal("y", count, 1, observed=DATA)
    with pytest.raises(ModelError, match=r"got discrete \['count'\]"):
        ModelDensity(model)


class TestStoredLogDensity:
    def stored(self, idata, values, name="lp"):
        idata["sample_stats"] = az.from_dict({"sample_stats": {name: values}})["sample_stats"]
        return idata

    @pytest.mark.parametrize("name", ["lp", "logp"])
    def test_is_used(self, idata, density, name):
        log_density = build_posterior(idata, density)[0].log_density
        marked = log_density + 1e-6
        found, _ = build_posterior(self.stored(idata, marked, name), density)
        np.testing.assert_array_equal(found.log_density, marked)

    def test_of_other_data_is_an_error(self, idata, density):
        log_density = build_posterior(idata, density)[0].log_density
        with pytest.raises(DataMismatchError, match="another model, other data"):
            build_posterior(self.stored(idata, log_density + 0.1), density)

    def test_of_several_step_methods_is_recomputed(self, idata, density):
        log_density = build_posterior(idata, density)[0].log_density
        columns = np.stack([log_density - 1, log_density - 2], axis=-1)
        found, _ = build_posterior(self.stored(idata, columns), density)
        np.testing.assert_array_equal(found.log_density, log_density)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda idata: idata["posterior"].to_dataset(), "must be a DataTree.*got Dataset"),
        (lambda idata: None, "must be a DataTree.*got NoneType"),
        (lambda idata: idata["posterior"], "must have a group 'posterior'"),
        (lambda idata: idata.isel(chain=0), "dimensions chain and draw.*isel"),
    ],
)
def test_what_is_no_idata_is_said(idata, model, wrong, message):
    with pytest.raises(ModelError, match=message):
        chib_jeliazkov(wrong(idata), model)
    with pytest.raises(ModelError, match=r"model must be a pymc\.Model, got str"):
        chib_jeliazkov(idata, "model")


def test_zeros_that_several_step_methods_leave_are_no_log_density(idata, model, density):
    expected = build_posterior(idata, density)[0].log_density
    idata["sample_stats"] = xr.DataTree(xr.Dataset({"lp": (("chain", "draw"), np.zeros((2, 30)))}))
    np.testing.assert_array_equal(build_posterior(idata, density)[0].log_density, expected)
    moved = ModelDensity(model, moved=True)
    with pytest.raises(DataMismatchError, match="all variables by one DRAM step"):
        build_posterior(idata, moved)


def test_a_parameter_that_does_not_vary_hides_no_disagreement():
    values = np.random.default_rng(1).standard_normal((2, 100, 2))
    values[..., 0] = 1.0
    values[1, :, 1] += 10
    (doubt,) = check_convergence(Posterior(values, values[..., 1], lambda x, rng: x[:, 1]))
    assert "the chains disagree" in doubt


def normal_chains(shift):
    """Four chains of 500 independent draws, the last shifted; and their log-densities."""
    values = np.random.default_rng(1).standard_normal((4, 500, 1))
    values[3] += shift
    return Posterior(values, -0.5 * values[..., 0] ** 2, lambda x, rng: -0.5 * x[:, 0] ** 2)


def test_chains_that_disagree_are_told_how_many_more_draws_would_do():
    posterior = normal_chains(2.0)
    (doubt,) = check_convergence(posterior)
    ess = float(az.ess(posterior.draws[..., 0]))
    assert 5 < ess < 50
    factor = math.ceil(400 / ess)
    assert f"sample size is {ess:.0f}; draws={factor * posterior.draws.shape[1]} would" in doubt
    assert f"about {factor} times as many iterations" in doubt
    assert "until_ess" not in doubt
    drawn_by_dram = xr.DataTree()
    drawn_by_dram.attrs["refresh_noise"] = 1
    (doubt,) = check_convergence(posterior, drawn_by_dram)
    assert "until_ess=400 of sample_dram would give 400" in doubt
    assert not list(check_convergence(normal_chains(0.0)))


def test_a_chain_far_below_the_others_needs_no_more_draws():
    (doubt,) = check_convergence(normal_chains(50.0))
    assert re.search(r"chain 3 stayed 1\d{3} nats below chain \d \(median log-density\)", doubt)
    assert "initvals" in doubt
    assert "times as many" not in doubt


def test_transforms_of_matrices_get_arrays():
    """Correlations go through Python code of PyMC, which needs arrays."""
    rng = np.random.default_rng(1)
    with pm.Model() as model:
        pm.LKJCorr("c", n=3, eta=2.0)
    value = model.value_vars[0]
    at = rng.normal(size=(2, 20, 3))
    backward = model.compile_fn(model.unobserved_value_vars, point_fn=False, mode=AS_IT_STANDS)
    drawn = [[backward(point)[-1] for point in chain] for chain in at]
    idata = az.from_dict({"posterior": {"c": np.array(drawn)}})
    np.testing.assert_allclose(unconstrained_draws(idata, model), at, atol=1e-9)
    assert value.type.ndim == 1
