"""The multiplier of small deviations along a system's path, against what it is by hand."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.pymc_model.overshoot import smallest_multiplier

OBSERVED = {"observation": lambda x: [x[0]], "observation_noise": [[0.1]]}


def euler(drift, n=1, substeps=1, mean=1.0, **kwargs):
    return psf.StateSpaceModel(
        transition=psf.EulerMaruyama(drift, 0.3 * np.eye(n), dt=0.1, substeps=substeps),
        initial_mean=[mean] * n,
        initial_cov=np.eye(n),
        **OBSERVED,
        **kwargs,
    )


def multiplier(system, theta, n_steps=100, inputs=None, t0=0.0):
    m = len(theta)
    inputs = np.zeros((0, system.n_inputs)) if inputs is None else inputs
    return smallest_multiplier(
        system,
        np.asarray(theta),
        np.tile(np.arange(n_steps + 1), (m, 1)),
        np.tile(inputs, (m, 1, 1)),
        np.full(m, t0),
    )


@pytest.mark.parametrize("substeps", [1, 2, 5])
def test_a_linear_state(substeps):
    """Of one substep: that of two is positive again where each overshoots."""
    a = np.array([[-1.0], [-9.0], [-15.0], [2.0]])
    found = multiplier(euler(lambda x, a: [a * x[0]], substeps=substeps), a, n_steps=10)
    np.testing.assert_allclose(found, 1 + a[:, 0] * 0.1 / substeps, rtol=1e-12)


def test_the_path_finds_the_well():
    """From 0.5 it falls into the well at 1, where the slope is -2 alpha."""
    found = multiplier(euler(lambda x, a: [a * (x[0] - x[0] ** 3)], mean=0.5), [[3.0], [6.0]])
    np.testing.assert_allclose(found, [1 - 0.6, 1 - 1.2], atol=1e-4)


def test_a_path_without_end_is_minus_infinity():
    found = multiplier(euler(lambda x, a: [a * x[0] ** 3], mean=5.0), [[-1.0], [-0.01]])
    assert found[0] == -np.inf
    assert np.isfinite(found[1])


def test_an_oscillator_does_not_overshoot():
    """Complex multipliers 1 - c h / 2 +- i w h: it is their real part that counts."""
    found = multiplier(euler(lambda x, c: [x[1], -25 * x[0] - c * x[1]], n=2), [[0.4]])
    np.testing.assert_allclose(found, 1 - 0.4 * 0.1 / 2, rtol=1e-9)


def test_inputs_and_time_move_the_path():
    """A slope of -(u + t) x at steps of 0.1: the last of u and of t count."""
    system = euler(lambda x, u, t, b: [-(u[0] + t) * b * x[0]], substeps=2, inputs=["u"])
    found = multiplier(system, [[1.0]], 10, np.arange(10.0)[:, None], t0=3.0)
    np.testing.assert_allclose(found, 1 - (9 + 4.0) * 0.05, rtol=1e-9)
