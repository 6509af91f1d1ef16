"""More noises than states are drawn as one noise of the same law, where there is one."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system


def system(diffusion, dt=0.25, substeps=1):
    return psf.StateSpaceModel(
        transition=psf.EulerMaruyama(
            lambda x, a: [a * x[1], -x[0]], diffusion, dt=dt, substeps=substeps
        ),
        observation=lambda x: [x[0]],
        observation_noise=[[1.0]],
        initial_mean=[1.0, 2.0],
        initial_cov=np.zeros((2, 2)),
    )


def correlated(sigma):
    return [[0.6, sigma, 0.0], [0.0, 0.5, 2.0]]


def test_one_step_has_the_mean_and_covariance_of_all_noises():
    merged = system(correlated)
    machine = compile_system(merged)
    assert (merged.m, machine.m) == (3, 2)
    c = machine.prepare.function(np.array([0.7, 0.3]))
    # The rows of the identity as noise read the square root off the step.
    X = np.repeat([[1.0], [2.0]], 3, axis=1)
    Z = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    machine.propagate.function(c, np.zeros((0, 0)), 0, 0.0, Z, X)
    assert X[:, 0] == pytest.approx([1.0 + 0.25 * 0.7 * 2.0, 2.0 - 0.25])
    root = X[:, 1:] - X[:, :1]
    gain = np.array([[0.6, 0.3, 0.0], [0.0, 0.5, 2.0]])
    np.testing.assert_allclose(root @ root.T, 0.25 * gain @ gain.T, rtol=1e-12)


@pytest.mark.parametrize(
    "kept",
    [
        system(lambda x, sigma: [[0.6, sigma * x[0], 0.0], [0.0, 0.5, 2.0]]),
        system(lambda t, sigma: [[0.6, sigma * t, 0.0], [0.0, 0.5, 2.0]]),
        system(lambda sigma: [[0.6], [sigma]]),
    ],
    ids=["of the state", "of time", "fewer"],
)
def test_other_noises_stay_as_they_are(kept):
    assert compile_system(kept).m == kept.m


def test_substeps_of_a_linear_system_are_one_noise_too():
    assert compile_system(system(correlated, substeps=2)).m == 2


def test_no_spread_in_one_direction_is_no_failure():
    machine = compile_system(system(lambda sigma: [[0.0, 0.0, 0.0], [0.6, sigma, 1.0]]))
    X, Z = np.ones((2, 4)), np.arange(8.0).reshape(2, 4)
    machine.propagate.function(
        machine.prepare.function(np.array([1.0, 0.0])), np.zeros((0, 0)), 0, 0.0, Z, X
    )
    assert np.ptp(X[0]) == 0.0
    assert X[1] == pytest.approx(0.75 + 0.5 * np.hypot(0.6, 1.0) * Z[1])
