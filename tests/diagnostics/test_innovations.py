"""Innovations against exact ones, a planted surprise, and what innovations correlate with."""

import warnings

import arviz as az
import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.diagnostics import predictions
from pymc_statespace_filters.diagnostics.calibration import (
    autocorrelation_of,
    input_correlation_of,
    inputs_before,
    lags_of,
    standardised,
)
from pymc_statespace_filters.pymc_model import observation_moments
from tests.references.linear_states import linear_states
from tests.systems import PAIR, PAIR_DATA, STEPS

pytestmark = pytest.mark.usefixtures("interpreted")

A, Q, R, P0 = 0.8, 0.3, 0.2, 1.0
LONG = np.arange(1, 301)
SURPRISE = 200


def forced(observation):
    return psf.StateSpaceModel(
        transition=lambda x, q, u, a, b: [a * x[0] + b * u[0] + q[0]],
        process_noise=[[Q]],
        observation=observation,
        observation_noise=[[R]],
        initial_mean=[0.0],
        initial_cov=[[P0]],
        inputs=["force"],
    )


FORCED = forced(lambda x: [x[0]])


def diagnosed(system, filter, observed, steps, n_draws=200, inputs=None, **values):
    with pm.Model() as model:
        for name in values:
            pm.Normal(name)
        psf.StateSpace("d", system, filter, steps=steps, observed=observed, inputs=inputs)
    draws = {name: np.full((2, n_draws // 2), value) for name, value in values.items()}
    idata = az.from_dict({"posterior": draws})
    found = psf.filter_diagnostics(idata, model, random_seed=1)
    return found["filter_diagnostics"].to_dataset()


@pytest.fixture(scope="module")
def forced_record():
    """A record with a surprise of six predicted deviations, and the exact predictions of it."""
    force = np.random.default_rng(8).normal(size=(LONG[-1] + 1, 1))
    params = {"a": A, "b": 1.0}
    simulated = psf.simulate(FORCED, params, steps=LONG, inputs=force, random_seed=3)
    observed = simulated["observations"].values.copy()

    def predicted(rows):
        law = linear_states(
            [[A]], [[Q]], [[1.0]], [[R]], [0.0], [[P0]],
            steps=LONG, observed=observed, rows=rows, moment="predicted", forcing=force,
        )  # fmt: skip
        return law.mean[:, 0], np.sqrt(law.sd[:, 0] ** 2 + R)

    mean, sd = predicted(LONG[[SURPRISE]])
    observed[SURPRISE] = mean + 6.0 * sd
    return force, observed, *predicted(LONG)


def test_innovations_of_a_linear_system_are_kalmans():
    noise = np.array([[0.5, 0.1], [0.1, 0.4]])
    law = linear_states(
        [[0.5, 0.2], [0.0, 0.8]], np.diag([1.0, 0.5]), np.eye(2), noise, [0.0, 0.3],
        np.diag([1.0, 2.0]), steps=STEPS, observed=PAIR_DATA, rows=STEPS, moment="predicted",
    )  # fmt: skip
    j = np.arange(STEPS.size)
    cov = law.cov[j, :, j] + noise
    found = diagnosed(PAIR, psf.EKF(), PAIR_DATA, STEPS, 10, a=0.5, b=0.2)
    np.testing.assert_allclose(found["d_innovation"], PAIR_DATA - law.mean, atol=1e-9)
    np.testing.assert_allclose(found["d_innovation_cov"], cov, atol=1e-9)
    z = (PAIR_DATA - law.mean) / np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    np.testing.assert_allclose(found["d_residual"], z, atol=1e-9)
    assert not found["d_clipped"].any()


def test_draws_with_inputs_of_their_own_in_pieces(monkeypatch):
    """The mean of exact predictions for each draw, whatever the number of draws at once."""
    system = forced(lambda x, u: [x[0] + u[0]])
    force, steps = np.random.default_rng(8).normal(size=(9, 1)), np.arange(1, 9)
    observed = np.random.default_rng(9).normal(size=8)
    a, scale = np.array([[0.2, 0.5, 0.8]]), np.array([[1.0, -2.0, 0.5]])
    with pm.Model() as model:
        pm.Normal("a")
        inputs = pm.Normal("scale") * force
        params = {"b": 1.0}
        psf.StateSpace(
            "d", system, psf.EKF(), steps=steps, observed=observed, inputs=inputs, params=params
        )
    idata = az.from_dict({"posterior": {"a": a, "scale": scale}})
    whole = psf.filter_diagnostics(idata, model, random_seed=1)["filter_diagnostics"].to_dataset()
    monkeypatch.setattr(predictions, "_MOST_NUMBERS", 1.0)
    pieces = psf.filter_diagnostics(idata, model, random_seed=1)["filter_diagnostics"].to_dataset()
    assert pieces.identical(whole)
    means = []
    for phi, s in zip(a[0], scale[0], strict=True):
        law = linear_states(
            [[phi]], [[Q]], [[1.0]], [[R]], [0.0], [[P0]],
            steps=steps, observed=observed[:, None] - s * force[steps], rows=steps,
            moment="predicted", forcing=s * force,
        )  # fmt: skip
        means.append(law.mean[:, 0] + s * force[steps, 0])
    expected = observed - np.mean(means, axis=0)
    np.testing.assert_allclose(whole["d_innovation"][:, 0], expected, atol=1e-9)


@pytest.mark.filterwarnings("ignore::pymc_statespace_filters.errors.FilterWarning")
def test_predictions_before_a_failure_count():
    """A draw whose filter fails in row 10 predicts the rows before as those of a shorter record."""
    system = psf.StateSpaceModel(
        transition=lambda x, q, a: [a * x[0] + q[0]],
        process_noise=[[Q]],
        observation=lambda x: [x[0]],
        observation_noise=lambda t, a: [[1.0 - 0.08 * t * a]],
        initial_mean=[0.0],
        initial_cov=[[P0]],
    )
    steps, observed = np.arange(13), np.linspace(-0.5, 1.0, 13)
    whole = diagnosed(system, psf.EKF(), observed, steps, 4, a=1.5)
    part = diagnosed(system, psf.EKF(), observed[:10], steps[:10], 4, a=1.5)
    assert whole["d_failed"] == 1.0
    for name in ("d_innovation", "d_innovation_cov", "d_pit"):
        values = whole[name].values
        np.testing.assert_array_equal(values[:10], part[name])
        assert np.isnan(values[10:]).all()


def test_observations_of_known_states_need_no_derivative(monkeypatch):
    """Which takes longer than all else where there are millions of states."""
    system = forced(lambda x, u: [x[0] ** 2 + u[0]])
    monkeypatch.setattr(observation_moments.pt, "grad", None)
    x, force = np.array([[2.0], [np.nan]]), np.array([[0.5], [0.5]])
    mean, cov = observation_moments.moments_of_observations(
        system, observation_moments.Moments(x, None), np.zeros(2), force, np.ones((2, 2))
    )
    np.testing.assert_array_equal(mean, [[4.5], [np.nan]])
    np.testing.assert_array_equal(cov, [[[R]], [[np.nan]]])


@pytest.mark.parametrize(("filter", "tolerance"), [(psf.EKF(), 1e-8), (psf.GridFilter(), 0.02)])
def test_a_surprise_of_six_deviations_shows_as_six(filter, tolerance, forced_record):
    """A grid wider than the noise has an error of a hundredth in its tails."""
    force, observed, mean, sd = forced_record
    found = diagnosed(FORCED, filter, observed, LONG, 4, inputs=force, a=A, b=1.0)
    residual = found["d_residual"].values[:, 0]
    assert residual[SURPRISE] == pytest.approx(6.0, abs=6 * tolerance)
    np.testing.assert_allclose(residual, (observed[:, 0] - mean) / sd, atol=6 * tolerance)
    assert not found["d_clipped"].any()
    np.testing.assert_allclose(found["d_innovation"][:, 0], observed[:, 0] - mean, atol=1e-6)
    np.testing.assert_allclose(found["d_innovation_cov"][:, 0, 0], sd**2, rtol=1e-6)


def test_with_particles_it_is_cut_off_and_said_to_be(forced_record):
    """Predicted moments of 400 draws: within five standard errors."""
    force, observed, _, _ = forced_record
    with pytest.warns(psf.errors.FilterWarning, match="fewer than 3 particles") as caught:
        found = diagnosed(
            FORCED, psf.BootstrapPF(100), observed, LONG, 400, inputs=force, a=A, b=1.0
        )
    assert len(caught) == 1
    assert found["d_clipped"].values[SURPRISE, 0]
    assert found["d_clipped"].sum() < 10
    assert 2.5 < found["d_residual"].values[SURPRISE, 0] < 4
    sd = np.sqrt(found["d_innovation_cov"].values[SURPRISE, 0, 0])
    z = found["d_innovation"].values[SURPRISE, 0] / sd
    assert z == pytest.approx(6.0, abs=5 * 6 / np.sqrt(2 * 400))


def test_white_innovations_pass_and_wrong_models_do_not(forced_record):
    """19 of 20 lags within the band: more than six of 25 outside once in 1000 records."""
    force, observed, mean, _ = forced_record
    observed = observed.copy()
    observed[SURPRISE] = mean[SURPRISE]
    bound = 1.96 / np.sqrt(LONG.size)
    right = diagnosed(FORCED, psf.EKF(), observed, LONG, 4, inputs=force, a=A, b=1.0)
    for name in ("d_autocorrelation", "d_input_correlation"):
        assert (np.abs(right[name]) > bound).sum() <= 6
        assert (np.abs(right[name]) < 2 * bound).all()
    assert right["d_input_correlation"].dims == ("input_lag", "input", "observable")
    assert list(right["input"].values) == ["force"]

    deaf = diagnosed(FORCED, psf.EKF(), observed, LONG, 4, inputs=force, a=A, b=0.5)
    assert deaf["d_input_correlation"].sel(input_lag=0).item() > 4 * bound
    slow = diagnosed(FORCED, psf.EKF(), observed, LONG, 4, inputs=0 * force, a=0.0, b=1.0)
    assert slow["d_autocorrelation"].sel(lag=1).item() > 4 * bound
    assert slow["d_whiteness"].item() < 1e-4


def test_lags_are_counted_towards_the_past():
    """A record of period three, and one that follows an input two rows later."""
    rng, lags = np.random.default_rng(4), np.arange(1, 6)
    periodic = np.tile(rng.normal(size=3), 20)[:, None]
    found = autocorrelation_of(periodic, lags)[:, 0]
    np.testing.assert_array_equal(np.isclose(found, 1.0), lags == 3)
    inputs = rng.normal(size=(60, 2))
    late = np.full((60, 1), np.nan)
    late[2:, 0] = inputs[:-2, 1]
    found = input_correlation_of(late, inputs, np.insert(lags, 0, 0))
    assert found.shape == (6, 2, 1)
    np.testing.assert_array_equal(np.argwhere(np.isclose(found, 1.0)), [[2, 1, 0]])


def test_lags_inputs_and_scales_of_innovations():
    for n_observations, most in [(300, 25), (40, 10), (2, 1)]:
        np.testing.assert_array_equal(lags_of(n_observations), np.arange(1, most + 1))
    before = inputs_before(np.array([[10.0], [11.0], [12.0]]), np.array([0, 1, 3]))
    np.testing.assert_array_equal(before, [[np.nan], [10.0], [12.0]])
    z = standardised(np.array([[2.0, -9.0]]), np.array([[[4.0, 1.0], [1.0, 9.0]]]))
    np.testing.assert_array_equal(z, [[1.0, -3.0]])


def test_a_healthy_filter_says_nothing(forced_record):
    force, observed, _, _ = forced_record
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        diagnosed(
            FORCED, psf.BootstrapPF(200), observed[:50], LONG[:50], 10, inputs=force, a=A, b=1.0
        )
