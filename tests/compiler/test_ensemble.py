"""What a system gives to the filters, against the functions that the user wrote."""

import numpy as np
import pytensor.tensor as pt
import pytest
from scipy import stats

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.codegen import functions as lowering
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.compiler.numerics.small_cholesky import covariance_root

N = 5
INPUTS = np.array([[0.3], [0.7], [-0.2]])
THETA = np.array([0.5, 0.2, 1.3])  # a, s, r


def drift(x, u, t, a):
    return [x[1], -a * x[0] + u[0] * pt.cos(t)]


def pendulum(observed_with_e):
    if observed_with_e:
        seen = lambda x, e, u, r: [x[0] * (1 + e[0]) + u[0], x[1] + r * e[1]]  # noqa: E731
    else:
        seen = lambda x, u, r: [x[0] + u[0], r * x[1]]  # noqa: E731
    return psf.StateSpaceModel(
        transition=psf.EulerMaruyama(drift, lambda s: [[0.0], [s]], dt=0.1),
        observation=seen,
        observation_noise=[[0.4, 0.1], [0.1, 0.3]],
        initial_mean=lambda a: [a, 0.0],
        initial_cov=[[0.5, 0.0], [0.0, 0.0]],
        inputs=["force"],
    )


def decay():
    return psf.StateSpaceModel(
        transition=psf.EulerMaruyama(
            lambda x, u, t, a: [u[0] * pt.cos(t) - a * x[0]], lambda s: [[s]], dt=0.1
        ),
        observation=lambda x, u, r: [r * x[0] + u[0]],
        observation_noise=[[0.4]],
        initial_mean=lambda a: [a],
        initial_cov=[[0.5]],
        inputs=["force"],
    )


def states():
    return np.random.default_rng(3).normal(size=(2, N))


def test_members_move_and_are_seen_as_written():
    machine, rng = compile_system(pendulum(False)), np.random.default_rng(1)
    c, Z, X = machine.prepare.function(THETA), rng.normal(size=(2, 64)), np.empty((2, N))
    a, s, r = THETA

    machine.initialise.function(c, Z, X)
    np.testing.assert_allclose(X, [a + np.sqrt(0.5) * Z[0, :N], np.zeros(N)], rtol=1e-12)

    X = states()
    force = INPUTS[1, 0] * np.cos(0.25)
    expected = [
        X[0] + 0.1 * X[1],
        X[1] + 0.1 * (-a * X[0] + force) + np.sqrt(0.1) * s * Z[0, :N],
    ]
    moved = X.copy()
    machine.propagate.function(c, INPUTS, 1, 0.25, Z[:1], moved)
    np.testing.assert_allclose(moved, expected, rtol=1e-12)

    D, root = np.empty((2, N)), np.linalg.cholesky([[0.4, 0.1], [0.1, 0.3]])
    machine.observe.function(c, INPUTS, 2, 0.0, Z, X, D)
    seen = np.array([X[0] + INPUTS[2, 0], r * X[1]])
    np.testing.assert_allclose(D, seen + root @ Z[:, :N], rtol=1e-12)

    out, d = np.empty(N), np.array([0.2, -0.4])
    machine.log_density.function(c, INPUTS, 2, 0.0, d, X, out)
    true = stats.multivariate_normal([0, 0], [[0.4, 0.1], [0.1, 0.3]]).logpdf((d[:, None] - seen).T)
    np.testing.assert_allclose(out, true, rtol=1e-12)
    machine.log_density.function(c, INPUTS, 2, 0.0, np.array([np.nan, -0.4]), X, out)
    np.testing.assert_allclose(out, stats.norm(seen[1], np.sqrt(0.3)).logpdf(-0.4), rtol=1e-12)


def test_so_they_do_on_arrays(monkeypatch):
    """With one state: each operation of array code takes its time to compile."""
    monkeypatch.setattr(lowering, "MAX_EXPRESSIONS", 0)
    machine, rng = compile_system(decay()), np.random.default_rng(1)
    c, Z, X = machine.prepare.function(THETA), rng.normal(size=(1, 64)), np.empty((1, N))
    a, s, r = THETA
    machine.initialise.function(c, Z, X)
    np.testing.assert_allclose(X, a + np.sqrt(0.5) * Z[:, :N], rtol=1e-12)
    moved = X.copy()
    machine.propagate.function(c, INPUTS, 1, 0.25, Z, moved)
    expected = X + 0.1 * (INPUTS[1, 0] * np.cos(0.25) - a * X) + np.sqrt(0.1) * s * Z[:, :N]
    np.testing.assert_allclose(moved, expected, rtol=1e-12)
    D, out, seen = np.empty((1, N)), np.empty(N), r * X + INPUTS[2, 0]
    machine.observe.function(c, INPUTS, 2, 0.0, Z, X, D)
    np.testing.assert_allclose(D, seen + np.sqrt(0.4) * Z[:, :N], rtol=1e-12)
    machine.log_density.function(c, INPUTS, 2, 0.0, np.array([0.2]), X, out)
    np.testing.assert_allclose(out, stats.norm(seen[0], np.sqrt(0.4)).logpdf(0.2), rtol=1e-12)


def test_general_noise_has_the_covariance_d_gamma_d():
    machine = compile_system(pendulum(True))
    c, X, r = machine.prepare.function(THETA), states(), THETA[2]
    out, d = np.empty(N), np.array([0.2, -0.4])
    machine.log_density.function(c, INPUTS, 0, 0.0, d, X, out)
    gamma = np.array([[0.4, 0.1], [0.1, 0.3]])
    for i in range(N):
        D = np.diag([X[0, i], r])
        mean = [X[0, i] + INPUTS[0, 0], X[1, i]]
        true = stats.multivariate_normal(mean, D @ gamma @ D.T).logpdf(d)
        assert out[i] == pytest.approx(true, rel=1e-12)


@pytest.mark.parametrize("rank", [0, 1, 2, 3])
def test_square_root_of_a_singular_covariance(rank):
    factors = np.random.default_rng(rank).normal(size=(3, rank))
    cov = factors @ factors.T
    root = cov.copy()
    covariance_root(root)
    np.testing.assert_allclose(root @ root.T, cov, atol=1e-12)
    assert (np.triu(root, 1) == 0).all()


@pytest.mark.parametrize(
    "cov", [[[-1.0]], [[-np.inf]], [[np.inf]], [[1.0, 2.0], [2.0, 1.0]], [[0.0, 1.0], [1.0, 0.0]]]
)
def test_square_root_of_what_is_no_covariance_is_nan(cov):
    root = np.array(cov)
    covariance_root(root)
    assert np.isnan(root).all()
