"""Small Gaussian algebra against NumPy and SciPy."""

import numpy as np
import pytest
from numba import njit
from scipy.stats import multivariate_normal, norm

from pymc_statespace_filters.compiler.numerics.small_cholesky import (
    cholesky,
    log_gaussian,
    semidefinite_cholesky,
    solve_lower,
    solve_lower_transposed,
)
from pymc_statespace_filters.filters.point_mass.tiles import (
    LANES,
    multiply,
    tiles_to_sources,
    tiles_to_targets,
)
from tests.compiled import from_python

cholesky, log_gaussian, semidefinite_cholesky, solve_lower, solve_lower_transposed = map(
    from_python,
    (cholesky, log_gaussian, semidefinite_cholesky, solve_lower, solve_lower_transposed),
)


def random_covariance(n, seed, rank=None):
    A = np.random.default_rng(seed).standard_normal((n, n if rank is None else rank))
    return A @ A.T


@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_cholesky_is_numpys_with_zeros_above(n):
    A = random_covariance(n, seed=n)
    L = A.copy()
    assert cholesky(L)
    assert pytest.approx(np.linalg.cholesky(A), rel=1e-10, abs=1e-12) == L


@pytest.mark.parametrize(
    "A",
    [
        [[0.0]],
        [[-1.0]],
        [[np.nan]],
        [[np.inf]],
        [[1.0, 2.0], [2.0, 1.0]],
        [[0.01, 0.1], [0.1, 1.0]],  # singular: the last pivot is rounding noise
        [[1.0, np.nan], [np.nan, 1.0]],
    ],
)
def test_cholesky_says_what_is_not_positive_definite(A):
    assert not cholesky(np.array(A))


def test_semidefinite_factor_of_a_singular_matrix_reproduces_it():
    A = random_covariance(4, seed=1, rank=2)
    L, active = A.copy(), np.empty(4, dtype=bool)
    assert semidefinite_cholesky(L, np.zeros(4), active)
    assert active.tolist() == [True, True, False, False]
    assert np.all(L[:, 2:] == 0)
    assert L @ L.T == pytest.approx(A, rel=1e-10)


def test_semidefinite_factor_leaves_out_variances_below_the_floor():
    L, active = np.diag([1.0, 1e-20, 4.0]), np.empty(3, dtype=bool)
    assert semidefinite_cholesky(L, np.full(3, 1e-18), active)
    assert active.tolist() == [True, False, True]
    assert L.tolist() == np.diag([1.0, 0.0, 2.0]).tolist()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_semidefinite_factor_refuses_what_is_not_finite(bad):
    assert not semidefinite_cholesky(np.diag([1.0, bad]), np.zeros(2), np.empty(2, dtype=bool))


def test_triangular_solves():
    L = np.linalg.cholesky(random_covariance(5, seed=2))
    b = np.arange(1.0, 6.0)
    x, y = b.copy(), b.copy()
    solve_lower(L, x)
    solve_lower_transposed(L, y)
    assert L @ x == pytest.approx(b)
    assert L.T @ y == pytest.approx(b)


def test_log_gaussian_counts_only_the_components_that_are_there():
    A = random_covariance(3, seed=3)
    r = np.array([0.3, -1.0, 2.0])
    assert log_gaussian(r.copy(), np.linalg.cholesky(A), 3) == pytest.approx(
        multivariate_normal(np.zeros(3), A).logpdf(r)
    )
    padded = np.eye(4)
    padded[1:, 1:] = np.linalg.cholesky(A)
    assert log_gaussian(np.append(0.0, r), padded, 3) == pytest.approx(
        multivariate_normal(np.zeros(3), A).logpdf(r)
    )


# Transition kernels in tiles against their matrix: maps that fold, diverge or have no noise.


SPACING, REACH, SOURCE, LOW, HIGH = 0.1, 8.5, -40, -8, 9
X = (SOURCE + np.arange(80)) * SPACING


@njit(error_model="numpy", nogil=True)
def products(mean, sd, low, mass, first, values):
    forward = tiles_to_targets(SOURCE, SPACING, mean, sd, REACH, LOW, HIGH)
    backward = tiles_to_sources(SOURCE, SPACING, mean, sd, REACH, LOW, HIGH)
    sums = multiply(forward, low, mass, LOW, HIGH - LOW)
    return sums, multiply(backward, first, values, SOURCE // 8, mean.size // 8)


@pytest.mark.parametrize(
    "mean", [0.9 * X, -0.5 * X, 1.0 - 0.3 * X**2, np.where(X > 3.0, np.inf, X), 0.0 * X + 1e100]
)
def test_sums_are_products_with_the_matrix(mean):
    sd = 0.15 + 0.02 * abs(X)
    sd[5] = 0.0  # a source without noise is in no row
    targets = np.arange(LANES * LOW, LANES * HIGH) * SPACING
    is_regular = np.isfinite(mean) & (sd > 0.0)
    matrix = np.zeros((targets.size, X.size))
    law = norm(mean[is_regular], sd[is_regular])
    matrix[:, is_regular] = SPACING * law.pdf(targets[:, None])
    mass = np.random.default_rng(1).uniform(size=37)  # of the sources from -21 on
    values = np.random.default_rng(2).uniform(size=50)  # of the targets from -30 on
    sums, means = products(mean, sd, SOURCE + 19, mass, -30, values)
    np.testing.assert_allclose(sums, matrix[:, 19:56] @ mass, rtol=0.0, atol=1e-14)
    first = -30 - LANES * LOW
    np.testing.assert_allclose(means, values @ matrix[first : first + 50], rtol=0.0, atol=1e-14)
