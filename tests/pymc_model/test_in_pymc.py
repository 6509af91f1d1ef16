"""`StateSpace` under everything that PyMC does with a random variable."""

import arviz as az
import cloudpickle
import numpy as np
import pymc as pm
import pytensor
import pytest
from numba.core.event import install_recorder
from pymc.model.transform.optimization import freeze_dims_and_data

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import GradientUnavailableError, ModelError
from pymc_statespace_filters.pymc_model.distribution import StateSpace
from pymc_statespace_filters.pymc_model.inspection import noise_seeds
from tests.systems import (
    FORCE,
    FORCED,
    PAIR,
    PAIR_DATA,
    STEPS,
    forced_terms,
    pair_terms,
)

PF = psf.BootstrapPF(20)
POINT = {"a": np.array(0.6)}
SHORT = {
    "draws": 40, "tune": 40, "chains": 1, "cores": 1, "random_seed": 1, "progressbar": False,
    "compute_convergence_checks": False,
}  # fmt: skip


def pair_model(filter=psf.EKF(), observed=PAIR_DATA):  # noqa: B008 (settings are frozen)
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.2)
        psf.StateSpace("d", PAIR, filter, steps=STEPS, observed=observed, seed=3)
    return model


def terms(model, point=POINT):
    """The log-likelihood terms of `d`."""
    (values,) = model.compile_logp([model["d"]], sum=False, mode="FAST_COMPILE")(point)
    return values


# Models as values: other models are made of them.


@pytest.mark.parametrize("filter", [psf.EKF(), PF], ids=lambda f: type(f).__name__)
def test_transformed_models_have_the_same_density(filter):
    model = pair_model(filter)
    expected = psf.log_likelihood(PAIR, filter, POINT, PAIR_DATA, steps=STEPS, seed=3)
    np.testing.assert_array_equal(terms(model), expected)
    copied = cloudpickle.loads(cloudpickle.dumps(model))
    for other in (model.copy(), copied, freeze_dims_and_data(model)):
        np.testing.assert_array_equal(terms(other), expected)
        assert other.named_vars_to_dims["d"] == ("d_time", "observable")
    intervened = pm.do(model, {"a": np.array(0.6)})
    assert intervened.free_RVs == []
    np.testing.assert_array_equal(terms(intervened, {}), expected)
    np.testing.assert_array_equal(
        terms(pair_model(filter, None), POINT | {"d": PAIR_DATA}), expected
    )


def test_observing_later_imputes_nothing():
    model = pm.observe(pair_model(observed=None), {"d": PAIR_DATA})
    assert [v.name for v in model.free_RVs] == ["a"]
    np.testing.assert_allclose(terms(model), pair_terms(0.6), rtol=1e-12)


def test_a_copy_has_a_seed_of_its_own_and_a_frozen_model_none():
    model = pair_model(PF)
    noise_seeds(model.copy())["d"].set_value(np.array(99))
    assert model["d_seed"].get_value() == 3
    with pytest.raises(ModelError, match="noise seed of 'd' must be shared data"):
        noise_seeds(freeze_dims_and_data(model))


def test_the_seed_is_data():
    model = pair_model(PF)
    before = terms(model)
    with model:
        pm.set_data({"d_seed": np.int64(4)})
    assert np.abs(terms(model) - before)[0] > 1e-6


def test_printing(capsys):
    model = pair_model(PF)
    assert "d ~ StateSpace(f(a)" in model.str_repr()
    assert r"\operatorname{StateSpace}" in model._repr_latex_()
    assert "StateSpaceRV{BootstrapPF(n_particles=20" in str(model["d"].owner.op)
    with pytensor.config.change_flags(mode="FAST_COMPILE"):
        model.debug()
    assert "No problems found" in capsys.readouterr().out


def test_graph():
    pytest.importorskip("graphviz")
    assert "StateSpace" in pm.model_to_graphviz(pair_model(PF)).source


# Draws.


def test_draws_are_seeded_batched_and_the_same_in_every_mode():
    variable = pair_model(observed=None)["d"]
    draws = pm.draw(variable, 3, random_seed=1, mode="FAST_COMPILE")
    assert draws.shape == (3, 4, 2)
    again = pm.draw(variable, 3, random_seed=1, mode="FAST_COMPILE")
    np.testing.assert_array_equal(draws, again)
    assert np.abs(np.diff(draws, axis=0)).min() > 0
    theta = np.array([[0.6, 0.2], [0.1, 0.2], [-0.5, 0.0]])
    batch = StateSpace.dist(theta, STEPS, np.zeros((0, 0)), 0.0, 3, system=PAIR, filter=psf.EKF())
    assert batch.type.shape == (3, 4, 2)
    np.testing.assert_array_equal(
        pm.draw(batch, random_seed=1), pm.draw(batch, random_seed=1, mode="FAST_COMPILE")
    )
    logp = pm.logp(batch, np.stack([PAIR_DATA] * 3)).eval(mode="FAST_COMPILE")
    np.testing.assert_allclose(logp, [pair_terms(*t) for t in theta], rtol=1e-12)
    several = StateSpace.dist(
        theta[0], STEPS, np.zeros((0, 0)), 0.0, 3, system=PAIR, filter=psf.EKF(), size=(2,)
    )
    first, second = pm.draw(several, random_seed=1, mode="FAST_COMPILE")
    assert np.abs(first - second).min() > 0


def test_draws_in_python_compile_once():
    variable = pair_model(observed=None)["d"]
    draw = pytensor.function([], variable, mode="FAST_COMPILE")
    draw()
    with install_recorder("numba:compile") as compiled:
        draw()
    assert not compiled.buffer


def test_draws_have_the_law_of_the_system():
    """Mean and covariance of the observation at step 2, 4000 draws: 4.5 standard errors each."""
    A = np.array([[0.6, 0.2], [0.0, 0.8]])
    mean = A @ A @ [0.0, 0.3]
    cov = np.diag([1.0, 2.0])
    for _ in range(2):
        cov = A @ cov @ A.T + np.diag([1.0, 0.5])
    cov = cov + np.array([[0.5, 0.1], [0.1, 0.4]])
    with pm.Model():
        variable = psf.StateSpace("d", PAIR, psf.EKF(), params={"a": 0.6}, steps=[2])
    draws = pm.draw(variable, 4000, random_seed=1, mode="FAST_COMPILE")[:, 0]
    n_sd = (draws.mean(axis=0) - mean) / np.sqrt(np.diag(cov) / 4000)
    assert np.abs(n_sd).max() < 4.5
    sd_of_cov = np.sqrt((np.outer(np.diag(cov), np.diag(cov)) + cov**2) / 4000)
    assert np.abs((np.cov(draws.T) - cov) / sd_of_cov).max() < 4.5


def test_prior_predictive_has_coordinates_and_constant_data():
    with pair_model(PF):
        idata = pm.sample_prior_predictive(
            5, random_seed=1, compile_kwargs={"mode": "FAST_COMPILE"}
        )
    drawn = idata["prior_predictive"]["d"]
    assert drawn.dims == ("chain", "draw", "d_time", "observable")
    assert drawn["d_time"].to_numpy().tolist() == [0.0, 2.0, 3.0, 6.0]
    assert drawn["observable"].to_numpy().tolist() == ["position", "speed"]
    assert np.isfinite(drawn).all()
    assert idata["constant_data"]["d_seed"] == 3
    np.testing.assert_array_equal(idata["observed_data"]["d"], PAIR_DATA)


# Data that is exchanged.


@pytest.fixture
def exchangeable():
    """A record whose steps, inputs and observations are pm.Data."""
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.2)
        psf.StateSpace(
            "d",
            FORCED,
            psf.EKF(),
            steps=pm.Data("steps", STEPS, dims="d_time"),
            observed=pm.Data("y", np.ones((4, 1)), dims=("d_time", "observable")),
            inputs=pm.Data("force", FORCE),
        )
    return model


def test_exchanged_data_change_the_density(exchangeable):
    with exchangeable:
        before = forced_terms(0.6, np.ones(4))
        np.testing.assert_allclose(terms(exchangeable), before, rtol=1e-12)
        longer, force = np.arange(1, 20, 3), np.linspace(-1, 1, 19)
        observed = np.linspace(0, 1, 7)[:, None]
        pm.set_data({"steps": longer, "y": observed, "force": force})
    expected = forced_terms(0.6, observed, longer, force)
    np.testing.assert_allclose(terms(exchangeable), expected, rtol=1e-12)


def test_exchanging_data_with_gaps():
    """pm.Data refuses NaN, a shared variable does not."""
    observed = pytensor.shared(np.ones((4, 2)))
    model = pair_model(observed=observed)
    observed.set_value(PAIR_DATA)
    np.testing.assert_allclose(terms(model), pair_terms(0.6), rtol=1e-12)


def test_exchanged_data_that_do_not_fit_stop_with_a_reason(exchangeable):
    with exchangeable:
        pm.set_data({"steps": np.array([0, 2, 3, 60])})
        with pytest.raises(ModelError, match="inputs has too few rows"):
            terms(exchangeable)
        with pytest.raises(ModelError, match="inputs has too few rows"):
            pm.draw(exchangeable["d"], random_seed=1, mode="FAST_COMPILE")


def test_predictions_over_another_horizon(exchangeable):
    times = np.arange(10.0)
    posterior = az.from_dict({"posterior": {"a": np.full((1, 5), 0.6)}})
    with exchangeable:
        pm.set_data(
            {"steps": np.arange(10), "y": np.zeros((10, 1)), "force": np.full(9, 100.0)},
            coords={"d_time": times},
        )
        result = pm.sample_posterior_predictive(
            posterior,
            predictions=True,
            random_seed=1,
            progressbar=False,
            compile_kwargs={"mode": "FAST_COMPILE"},
        )
    drawn = result["predictions"]["d"]
    assert drawn.sizes == {"chain": 1, "draw": 5, "d_time": 10, "observable": 1}
    np.testing.assert_array_equal(drawn["d_time"], times)
    # The new force is felt: its steady state is 100 / (1 - 0.6) = 250.
    assert abs(drawn.isel(d_time=-1) - 250).max() < 20


# Sampling.


@pytest.mark.filterwarnings("ignore:the terms of a StateSpace variable")
def test_nuts_runs_on_the_extended_kalman_filter():
    with pair_model() as model:
        idata = pm.sample(nuts_sampler="pymc", **SHORT)
        with pytensor.config.change_flags(mode="FAST_COMPILE"):
            pm.compute_log_likelihood(idata, progressbar=False)
            pm.sample_posterior_predictive(
                idata, extend_inferencedata=True, random_seed=1, progressbar=False
            )
    log_likelihood = idata["log_likelihood"]["d"]
    assert log_likelihood.dims == ("chain", "draw", "d_time")
    draws = idata["posterior"]["a"].to_numpy()[0]
    assert len(np.unique(draws)) > 20
    exact = [pair_terms(a) for a in draws]
    np.testing.assert_allclose(log_likelihood[0], exact, rtol=1e-10)
    assert idata["posterior_predictive"]["d"].dims == ("chain", "draw", "d_time", "observable")
    assert az.summary(idata, var_names=["a"]).shape[0] == 1
    assert [v.name for v in model.free_RVs] == ["a"]


def test_default_sampler_is_nutpie():
    pytest.importorskip("nutpie")
    with pair_model():
        idata = pm.sample(**SHORT)
    assert idata["posterior"].attrs["inference_library"] == "nutpie"
    assert len(np.unique(idata["posterior"]["a"])) > 20


def test_gradient_of_a_model_agrees_with_central_differences():
    with pm.Model() as model:
        a = pm.Normal("a", 0.5, 0.2)
        scale = pm.HalfNormal("scale", 1)
        psf.StateSpace(
            "d", PAIR, psf.EKF(), params={"b": a * scale}, steps=STEPS, observed=PAIR_DATA
        )
    point = {"a": np.array(0.4), "scale_log__": np.array(-0.3)}
    # Together: alone each would be compiled with a forward pass of its own.
    both = model.compile_fn([model.logp(), model.dlogp()])
    gradient = both(point)[1]
    for i, name in enumerate(point):
        (up, _), (down, _) = (both({**point, name: point[name] + h}) for h in (1e-5, -1e-5))
        np.testing.assert_allclose(gradient[i], (up - down) / 2e-5, rtol=1e-6)


@pytest.mark.parametrize(
    "sample",
    [
        lambda: pm.sample(**SHORT),
        lambda: pm.sample(nuts_sampler="pymc", **SHORT),
        lambda: pm.sample(nuts_sampler="nutpie", **SHORT),
        lambda: pm.NUTS(),
        lambda: pm.find_MAP(progressbar=False, return_inferencedata=True, jitter=False),
        lambda: pm.fit(10, progressbar=False),
    ],
    ids=["sample", "pymc", "nutpie", "NUTS", "find_MAP", "ADVI"],
)
def test_gradient_samplers_stop_and_name_the_right_one(sample):
    """Each filter with noise says so: `test_ops.test_estimates_refuse_to_be_differentiated`."""
    with (
        pair_model(PF),
        pytest.raises(GradientUnavailableError, match=r"pm\.sample\(step=psf\.DRAM\(\)\)"),
    ):
        sample()


def test_other_samplers_run_on_estimates_and_leave_the_seed_alone():
    with pair_model(PF) as model:
        idata = pm.sample(step=psf.DRAM(), **SHORT)
        assert len(np.unique(idata["posterior"]["a"])) > 5
        assert model["d_seed"].get_value() == 3
        assert idata["constant_data"]["d_seed"] == 3
        with pytest.warns(psf.errors.FilterWarning, match="one noise seed throughout") as caught:
            idata = pm.sample(step=pm.DEMetropolisZ(), **SHORT)
        assert caught[0].filename == __file__
        assert len(np.unique(idata["posterior"]["a"])) > 5
        assert model["d_seed"].get_value() == 3
        settings = {k: SHORT[k] for k in ("draws", "chains", "random_seed", "progressbar")}
        with pytest.warns(psf.errors.FilterWarning, match="one noise seed throughout"):
            idata = pm.sample_smc(**settings, cores=1, compute_convergence_checks=False)
        assert len(np.unique(idata["posterior"]["a"])) > 5
        assert model["d_seed"].get_value() == 3
