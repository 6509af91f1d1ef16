"""The order of keys against NumPy's stable one."""

import numpy as np
import pytest
from numba import njit

from pymc_statespace_filters.compiler.numerics.order import stable_order


@njit
def order_of(keys):
    return stable_order(keys)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 7, 8, 9, 100])
def test_equal_keys_keep_their_order(n):
    for keys in (np.random.default_rng(n).integers(0, 4, n), -np.arange(n), np.arange(n)):
        np.testing.assert_array_equal(order_of(keys), np.argsort(keys, kind="stable"))
