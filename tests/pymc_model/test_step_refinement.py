"""Eigenvalues of the step's Jacobian along a system's path, against what they are by hand."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.pymc_model.step_refinement import path_eigenvalues

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
    """Smallest real part of an eigenvalue, which decides on Euler-Maruyama steps."""
    return eigenvalues(system, theta, n_steps, inputs, t0).real.min(axis=(1, 2))


def eigenvalues(system, theta, n_steps=100, inputs=None, t0=0.0):
    m = len(theta)
    inputs = np.zeros((0, system.n_inputs)) if inputs is None else inputs
    return path_eigenvalues(
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


def test_a_path_that_diverges_is_not_stable():
    system = euler(lambda x, a: [a * x[0] ** 3], mean=5.0)
    found = eigenvalues(system, [[-1.0], [-0.01]])
    assert np.isnan(found[0]).any()
    assert np.isfinite(found[1]).all()
    assert list(system.integrator.is_stable_at(found).all(axis=1)) == [False, True]


def test_an_oscillator_does_not_overshoot():
    """Complex multipliers 1 - c h / 2 +- i w h: it is their real part that counts."""
    found = multiplier(euler(lambda x, c: [x[1], -25 * x[0] - c * x[1]], n=2), [[0.4]])
    np.testing.assert_allclose(found, 1 - 0.4 * 0.1 / 2, rtol=1e-9)


def test_inputs_and_time_move_the_path():
    """A slope of -(u + t) x at steps of 0.1: the last of u and of t count."""
    system = euler(lambda x, u, t, b: [-(u[0] + t) * b * x[0]], substeps=2, inputs=["u"])
    found = multiplier(system, [[1.0]], 10, np.arange(10.0)[:, None], t0=3.0)
    np.testing.assert_allclose(found, 1 - (9 + 4.0) * 0.05, rtol=1e-9)


def test_an_euler_step_is_stable_while_no_eigenvalue_is_negative():
    step = psf.EulerMaruyama(lambda x, a: [a * x[0]], [[0.3]], dt=0.1)
    eigenvalues = np.array([[0.5, -0.1], [0.5, 0.0], [0.5, 0.1 + 2j], [0.5, np.nan]])
    assert list(step.is_stable_at(eigenvalues)) == [False, True, True, False]
