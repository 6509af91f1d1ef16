"""A study with noise of other distributions: chains, states, forecasts, stored noise, gradients."""

import pickle

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import (
    LogLikelihood,
    LogLikelihoodGradient,
    LogLikelihoodOfNoise,
    StoredNoise,
)

STEPS = np.arange(1, 13)
INPUTS = np.linspace(1.0, 2.0, 15)[:, None]
FILTER = psf.BootstrapPF(100)

# A start takes two normals, a state has one.
PATIENTS = psf.StateSpaceModel(
    transition=lambda x, q: [x[0] + q[0] - q[1]],
    process_dist=lambda x, u, rate: [pm.Poisson.dist(rate * u[0]), pm.Binomial.dist(x[0], 0.3)],
    observation=lambda x: [x[0]],
    observation_noise=[[9.0]],
    initial_dist=lambda: [pm.NegativeBinomial.dist(mu=8.0, alpha=20.0)],
    states=["patients"],
    inputs=["season"],
)
# Simulated with rate = 3.
OBSERVED = np.array([
    1.0758, 6.4459, 10.7061, 10.5316, 11.2531, 10.3581, 14.1406, 11.5112, 17.3276, 18.6305, 22.5361,
    18.0604,
])[:, None]  # fmt: skip


def model_with(filter):
    with pm.Model() as model:
        pm.Gamma("rate", 4.0, 1.0)
        psf.StateSpace("d", PATIENTS, filter, steps=STEPS, inputs=INPUTS, observed=OBSERVED)
    return model


@pytest.fixture(scope="module")
def study():
    model = model_with(FILTER)
    settings = {"model": model, "chains": 2, "progressbar": False, "random_seed": 1}
    return model, psf.sample_dram(200, tune=200, kernel={"screen": psf.EKF()}, **settings)


def test_chains_are_exact_and_a_kalman_filter_screens(study):
    _, idata = study
    assert idata.attrs["exact"] == 1
    assert 2.0 < idata["posterior"]["rate"].values.mean() < 4.5


def test_states_are_whole_numbers_by_ancestries(study):
    model, idata = study
    arguments = {"model": model, "random_seed": 1, "progressbar": False}
    idata = psf.smoothed_states(idata, n_draws=20, **arguments)
    idata = psf.forecast(idata, n_steps=3, n_draws=20, inputs=INPUTS, **arguments)
    assert FILTER.smoothing_method(compile_system(PATIENTS)).startswith("ancestries")
    for group in ("smoothed_states", "predictions"):
        states = idata[group]["d_states"].values
        np.testing.assert_array_equal(states, np.round(states))
        assert (states >= 0).all()


def test_a_run_without_noise_follows_the_means():
    path = psf.simulate(PATIENTS, {"rate": 3.0}, steps=STEPS, inputs=INPUTS, noise=False)
    expected = [8.0]
    for row in INPUTS[: STEPS[-1], 0]:
        expected.append(0.7 * expected[-1] + 3.0 * row)
    np.testing.assert_allclose(path["states"].values[:, 0], expected, rtol=1e-12)


def test_states_of_the_future_are_drawn_in_a_free_run(study):
    model, idata = study
    runs = [
        psf.free_run(idata, model=model, n_draws=10, noise=noise, random_seed=1)["free_run"]
        for noise in (True, False)
    ]
    assert (runs[0]["d_states"].values % 1.0 == 0.0).all()
    assert not (runs[1]["d_states"].values % 1.0 == 0.0).all()


def test_stored_normals_give_the_estimate_of_their_seed():
    """The start has places for its own number of normals."""
    arguments = np.array([3.0]), STEPS, OBSERVED, INPUTS, 0.0
    terms = evaluator(LogLikelihood(PATIENTS, FILTER))(*arguments, 7)[0]
    (normals,) = evaluator(StoredNoise(PATIENTS, FILTER))(STEPS, 7)
    assert FILTER.noise_sizes(compile_system(PATIENTS)).initial == 2
    held = evaluator(LogLikelihoodOfNoise(PATIENTS, FILTER))(*arguments, normals)[0]
    np.testing.assert_array_equal(held, terms)


def test_correlated_noise_moves_the_estimate_a_little():
    arguments = np.array([3.0]), STEPS, OBSERVED, INPUTS, 0.0
    system = compile_system(PATIENTS)
    smooth = FILTER.smooth(system)
    of_noise, rng = evaluator(LogLikelihoodOfNoise(PATIENTS, smooth)), np.random.default_rng(1)
    normals = rng.normal(size=(40, smooth.n_normals(system, STEPS[-1], STEPS.size)))
    others = np.sqrt(1 - 0.99**2) * rng.normal(size=normals.shape) + 0.99 * normals
    first, second = (
        np.array([of_noise(*arguments, z)[0].sum() for z in which]) for which in (normals, others)
    )
    assert (second - first).std() < 0.5 * first.std()


def test_the_gradient_of_a_kalman_filter_is_that_of_its_likelihood():
    for filter in (psf.EKF(), psf.UKF()):
        value = evaluator(LogLikelihood(PATIENTS, filter))
        rest = STEPS, OBSERVED, INPUTS, 0.0, 0
        gradient = evaluator(LogLikelihoodGradient(PATIENTS, filter))
        (found,) = gradient(np.array([3.0]), *rest, np.ones(STEPS.size))
        above, below = (value(np.array([3.0 + h]), *rest)[0].sum() for h in (1e-5, -1e-5))
        assert found[0] == pytest.approx((above - below) / 2e-5, rel=1e-6)
        assert not filter.is_exact_for(compile_system(PATIENTS))


def test_a_system_in_another_process_has_the_same_likelihood():
    again = pickle.loads(pickle.dumps(PATIENTS))
    terms = [
        psf.log_likelihood(s, FILTER, {"rate": 3.0}, OBSERVED, steps=STEPS, inputs=INPUTS, seed=2)
        for s in (PATIENTS, again)
    ]
    np.testing.assert_array_equal(*terms)
