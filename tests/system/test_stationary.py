"""The stationary distribution of a Markov chain."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError


def test_a_step_leaves_it_as_it_is():
    """Also with moves of probability zero."""
    P = np.array([[0.5, 0.5, 0.0], [0.0, 0.2, 0.8], [0.3, 0.0, 0.7]])
    pi = psf.stationary(P).eval()
    np.testing.assert_allclose(pi @ P, pi, rtol=1e-14)
    np.testing.assert_allclose(pi.sum(), 1.0, rtol=1e-14)


def test_other_shapes_are_refused():
    """By their shape."""
    with pytest.raises(ModelError, match=r"square matrix of static shape, got the shape \(2, 3\)"):
        psf.stationary(np.zeros((2, 3)))
