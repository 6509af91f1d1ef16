"""To borrowed arrays no references are counted, and their memory is given back."""

from typing import NamedTuple

import numpy as np
import pytest
from numba import njit
from numba.core.runtime import _nrt_python, rtsys

from pymc_statespace_filters.compiler.native.borrowed import borrowed


class Inner(NamedTuple):
    x: np.ndarray
    n: int


class Outer(NamedTuple):
    inner: Inner
    y: np.ndarray


@njit
def named(outer):
    """Give parts of a tuple other names, not the same ones on all paths."""
    total, row = 0.0, outer.y
    for i in range(outer.inner.n):
        if row[0] < 3.0:
            inner = outer.inner
            row = inner.x[i]
        else:
            row = outer.y
        total += (i + 1) * row[0]
    return total


@njit
def counting(outer):
    return named(outer)


@njit
def borrowing(outer):
    return named(borrowed(outer))


@njit
def listing(outer):
    return Outer(outer.inner, [outer.y, outer.inner.x[0]])


@njit
def with_a_list(n):
    owner = listing(Outer(Inner(np.ones((n, n)), n), np.arange(1.0, n + 1.0)))
    inner, arrays = borrowed(owner)
    arrays.append(inner.x[1])
    return inner.x[0, 0] + arrays[0][1], len(owner.y)


@pytest.fixture
def outer():
    return Outer(Inner(np.arange(6.0).reshape(3, 2), 3), np.array([1.0, 10.0]))


@pytest.fixture
def memory_given_back():
    _nrt_python.memsys_enable_stats()
    before = rtsys.get_allocation_stats()
    yield
    after = rtsys.get_allocation_stats()
    _nrt_python.memsys_disable_stats()
    assert after.alloc - before.alloc == after.free - before.free > 0


def test_the_values_are_the_same_and_nothing_is_counted(outer, memory_given_back):
    assert counting(outer) == borrowing(outer) == 0.0 + 2 * 2.0 + 3 * 4.0
    codes = ["".join(f.inspect_llvm().values()) for f in (counting, borrowing)]
    counted, not_counted = (code.count("call void @NRT_incref") for code in codes)
    assert counted > 0
    assert not_counted == 0


def test_what_is_no_array_stays_an_owner(memory_given_back):
    total, n_arrays = with_a_list(4)
    assert total == 1.0 + 2.0
    assert n_arrays == 3
