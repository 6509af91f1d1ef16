"""The stationary distribution of a Markov chain."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system import stationary


def test_a_step_leaves_it_as_it_is():
    """Also with moves of probability zero."""
    P = np.array([[0.5, 0.5, 0.0], [0.0, 0.2, 0.8], [0.3, 0.0, 0.7]])
    pi = stationary(P).eval()
    np.testing.assert_allclose(pi @ P, pi, rtol=1e-14)
    np.testing.assert_allclose(pi.sum(), 1.0, rtol=1e-14)


def test_values_that_are_left_for_ever():
    """They have no mass, and a value that is never left has all of it."""
    np.testing.assert_allclose(stationary([[0.9, 0.1], [0.0, 1.0]]).eval(), [0, 1], atol=1e-290)
    P = [[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.3, 0.3, 0.4]]
    np.testing.assert_allclose(stationary(P).eval(), [0.5, 0.5, 0.0], rtol=1e-14)


def test_rare_moves():
    """Relative errors are those of the probabilities; differences would lose nine digits."""
    rare = 1e-9
    P = [[1 - rare, rare, 0.0], [rare, 1 - 3 * rare, 2 * rare], [0.0, rare, 1 - rare]]
    np.testing.assert_allclose(stationary(P).eval(), [0.25, 0.25, 0.5], rtol=1e-14)


def test_it_has_no_kinks():
    """A solution with pivots has them in the graph, so that three regimes would get no gradient."""
    system = psf.StateSpaceModel(
        transition=lambda x, q: [q[0]],
        process_dist=lambda x, P: [pm.Categorical.dist(P[pt.cast(x[0], "int64")])],
        observation_dist=lambda x: [pm.Poisson.dist(1.0 + x[0])],
        initial_dist=lambda P: [pm.Categorical.dist(stationary(P))],
        shapes={"P": (3, 3)},
    )
    assert psf.FiniteStateFilter().is_smooth_for(compile_system(system))


def test_other_shapes_are_refused():
    """By their shape."""
    with pytest.raises(ModelError, match=r"square matrix of static shape, got the shape \(2, 3\)"):
        stationary(np.zeros((2, 3)))
