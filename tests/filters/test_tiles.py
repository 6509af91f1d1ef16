"""Transition kernels in tiles against their matrix: maps that fold, diverge or have no noise."""

import numpy as np
import pytest
from numba import njit
from scipy.stats import norm

from pymc_statespace_filters.filters.point_mass.tiles import (
    LANES,
    multiply,
    tiles_to_sources,
    tiles_to_targets,
)

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
