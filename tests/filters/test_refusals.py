"""Parameters that no system can have are impossible under every filter alike."""

import numpy as np
import pytest

import pymc_statespace_filters as psf

FILTERS = [psf.EKF(), psf.EnKF(32), psf.BootstrapPF(32), psf.PFEnKF(32)]


def system(initial_cov=lambda p: [[p]]):
    return psf.StateSpaceModel(
        lambda x, q: [0.9 * x[0] + q[0]],
        lambda x: [x[0]],
        process_noise=lambda s: [[s]],
        observation_noise=lambda r: [[r]],
        initial_mean=[0.0],
        initial_cov=initial_cov,
    )


@pytest.mark.parametrize("filter", FILTERS, ids=lambda f: type(f).__name__)
@pytest.mark.parametrize("negative", ["p", "s", "r"])
def test_a_negative_variance_is_impossible(filter, negative):
    params = {"p": 1.0, "s": 0.3, "r": 0.5} | {negative: -0.2}
    with pytest.warns(psf.errors.FilterWarning, match="gave -inf: .* not positive semidefinite"):
        terms = psf.log_likelihood(system(), filter, params, [0.3, 0.1], steps=[1, 2])
    assert (terms == -np.inf).all()


def test_zero_variances_are_ordinary():
    params = {"p": 0.0, "s": 0.0, "r": 0.5}
    terms = psf.log_likelihood(system(), psf.EKF(), params, [0.3, 0.1], steps=[1, 2])
    expected = -0.5 * np.array([0.3, 0.1]) ** 2 / 0.5 - 0.5 * np.log(2 * np.pi * 0.5)
    np.testing.assert_allclose(terms, expected, rtol=1e-12)


def test_units_may_differ_by_many_orders():
    """Pascals beside millimetres: the small component keeps its spread."""
    cov = np.diag([1e12, 1e-6])
    units = psf.StateSpaceModel(
        lambda x: [x[0], x[1]],
        lambda x: [x[0], x[1]],
        observation_noise=cov,
        initial_mean=[0.0, 0.0],
        initial_cov=cov,
    )
    record = psf.simulate(units, {}, steps=range(200), random_seed=1)["observations"].values
    # A variance of 200 draws: within a half and twice of its mean but once in 1e9.
    assert 0.5e-6 < record[:, 1].var() < 2e-6


def test_nothing_to_nudge_is_a_bootstrap_filter():
    memory = psf.StateSpaceModel(
        lambda x, q: [0.9 * x[0] + q[0]],
        lambda x: [x[0]],
        process_noise=[[1.0]],
        observation_noise=[[0.5]],
        initial_mean=[0.0],
        initial_cov=[[1.0]],
        carried=["x0"],
    )
    record = {"observed": [0.3, 0.4, 0.2], "steps": [0, 1, 2], "seed": 5}
    nudged = psf.log_likelihood(memory, psf.PFEnKF(64), {}, **record)
    plain = psf.log_likelihood(memory, psf.BootstrapPF(64), {}, **record)
    np.testing.assert_array_equal(nudged, plain)


@pytest.mark.parametrize(
    "filter", [psf.EnKF(4000, likelihood="gaussian"), psf.BootstrapPF(4000)], ids=["EnKF", "PF"]
)
def test_inputs_hold_during_their_own_step(filter):
    """Inputs that change at every step by much more than the noise: one row off would show."""
    driven = psf.StateSpaceModel(
        lambda x, q, u: [0.5 * x[0] + u[0] + 0.1 * q[0]],
        lambda x: [x[0]],
        process_noise=[[1.0]],
        observation_noise=[[0.1]],
        initial_mean=[0.0],
        initial_cov=[[0.1]],
        inputs=["u"],
    )
    inputs = np.array([3.0, -2.0, 5.0, 1.0, -4.0])
    path = [0.0]
    for u in inputs:
        path.append(0.5 * path[-1] + u)
    record = {"observed": path[1:], "steps": range(1, 6), "inputs": inputs}
    exact = psf.log_likelihood(driven, psf.EKF(), {}, **record)
    terms = psf.log_likelihood(driven, filter, {}, **record)
    np.testing.assert_allclose(terms, exact, atol=0.15)
