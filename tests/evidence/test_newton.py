"""Newton's method on numbers: exact derivatives of a quadratic, and where there are none."""

import numpy as np
import pytest

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.estimators.newton import (
    EdgeError,
    best_of_chains,
    derivatives,
    newton_maximize,
)
from pymc_statespace_filters.evidence.estimators.whitening import moments, moments_within_chains


def test_coordinates_are_those_within_chains():
    rng = np.random.default_rng(43)
    within = rng.standard_normal((2, 100, 3))
    draws = within + np.array([-50.0, 50.0])[:, None, None]
    chol = moments_within_chains(draws).chol
    expected = np.mean([np.cov(chain, rowvar=False, ddof=0) for chain in within], axis=0)
    np.testing.assert_allclose(chol @ chol.T, expected, rtol=1e-12)


@pytest.mark.parametrize("coordinates", [moments, moments_within_chains])
def test_draws_that_do_not_vary_have_no_coordinates(coordinates):
    draws = np.random.default_rng(39).standard_normal((2, 500, 2))
    draws[..., 1] = 0.0
    with pytest.raises(ModelError, match="vary in every direction"):
        coordinates(draws)


def test_a_search_starts_in_the_best_chains():
    values = np.array([[0.0, 2.0, 1.0], [-9.0, -8.0, -7.0], [4.0, 3.0, 3.5]])
    assert best_of_chains(values, 2).tolist() == [6, 1]
    assert best_of_chains(values, 9).tolist() == [6, 1, 5]


@pytest.mark.parametrize(
    "climb", [lambda x: 0.01 * x[:, 0], lambda x: -np.exp(-x[:, 0])], ids=["grows", "levels off"]
)
def test_a_climb_without_end_ends(climb):
    found = newton_maximize(climb, np.zeros(1))
    assert found.value > climb(np.array([[3.0]]))[0]
    assert not found.at_edge


def test_derivatives_of_a_quadratic_are_exact():
    rng = np.random.default_rng(40)
    root, slope, point = rng.standard_normal((3, 3)), rng.standard_normal(3), np.ones(3)
    form = root @ root.T
    calls = []

    def quadratic(x):
        calls.append(len(x))
        return 0.5 * np.einsum("mi,ij,mj->m", x, form, x) + x @ slope

    gradient, hessian = derivatives(quadratic, point, 0.1)
    np.testing.assert_allclose(gradient, form @ point + slope, atol=1e-10)
    np.testing.assert_allclose(hessian, form, atol=1e-10)
    assert calls == [13]


def test_there_are_no_derivatives_at_an_edge():
    with pytest.raises(EdgeError):
        derivatives(lambda x: np.where(x[:, 0] < 0, -np.inf, x[:, 0]), np.array([0.05]), 0.1)
