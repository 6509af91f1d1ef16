"""Shares of the variance of a log-likelihood."""

import numpy as np
import pytest

from pymc_statespace_filters.sampling.particle_number.measurement import (
    is_concentrated,
    noisiest_terms,
)


def test_shares_are_those_of_independent_terms():
    """Standard deviations 3, 2, 1 and many of 0.1: nine, four and one fourteenth and a bit."""
    sd = np.array([1.0, 0.1, 3.0, *[0.1] * 20, 2.0])
    terms = sd * np.random.default_rng(1).normal(size=(200_000, sd.size))
    shares = noisiest_terms(terms)
    assert list(shares) == [2]
    assert shares[2] == pytest.approx(9.0 / (sd**2).sum(), abs=0.01)
    assert is_concentrated(shares, sd.size)
    assert list(noisiest_terms(terms[:, [0, 1, 23]])) == [2]


def test_errors_that_cancel_are_no_variance():
    """Two neighbouring terms off by opposite amounts, and one that stays."""
    error, other = np.random.default_rng(2).normal(size=(2, 1000))
    shares = noisiest_terms(np.column_stack([5.0 * error, -5.0 * error, other]))
    assert shares[2] == pytest.approx(1.0)


def test_failed_estimates_are_left_out_and_equal_ones_have_no_noise():
    terms = np.array([[-1.0, -2.0], [-np.inf, -np.inf], [-1.0, -3.0]])
    assert noisiest_terms(terms) == {1: 1.0}
    assert noisiest_terms(terms[:1]) == {}
    assert noisiest_terms(terms[1:2]) == {}


def test_variance_spread_evenly_is_not_concentrated():
    terms = np.random.default_rng(3).normal(size=(100, 60))
    assert not is_concentrated(noisiest_terms(terms), 60)
