"""References to arrays are counted where one is made or kept, and nowhere else."""

from typing import NamedTuple

import numpy as np
import pytest
from numba import njit, types
from numba.core.runtime import _nrt_python, rtsys

from pymc_statespace_filters.compiler.native.jit import njit_internal


class Parts(NamedTuple):
    x: np.ndarray
    y: np.ndarray


def borrows(parts, indices):
    both, total = Parts(parts.y, parts.x), 0.0
    row = both.x[0]
    for i in indices:
        total += row[i] + parts.x[1, i] * both.y.ctypes.data
        row = parts.x[i]
    return total


def returns(parts, indices):
    return parts.y[indices[0]]


def makes(parts, indices):
    return np.empty(indices.size).size


def adds(parts, indices):
    return (parts.x + parts.y).size


def copies(parts, indices):
    return parts.x[0][indices].size


def keeps(parts, indices):
    kept = [parts.x]
    kept.append(parts.y)
    return kept[1].size


ARRAY = types.Array(types.float64, 2, "C")
ARGUMENTS = types.NamedTuple([ARRAY, ARRAY], Parts), types.Array(types.int64, 1, "C")


@pytest.mark.parametrize("function", [borrows, returns, makes, adds, copies, keeps])
def test_only_a_function_that_borrows_counts_nothing(function):
    compiled = njit_internal(function)
    compiled.compile(ARGUMENTS)
    (found,) = compiled.overloads.values()
    code = found.library.get_llvm_str()
    assert ("NRT_incref" in code or "NRT_Allocate" in code) == (function is not borrows)


def test_all_memory_is_given_back_and_none_of_it_too_early():
    borrowing, returning, keeping = map(njit_internal, (borrows, returns, keeps))

    @njit
    def run(n):
        parts, indices, total = Parts(np.ones((n, n)), np.ones((n, n))), np.arange(n), 0.0
        for _ in range(10):
            row = returning(parts, indices)
            total += borrowing(parts, indices) * 0.0 + keeping(parts, indices) + row[0]
            parts = Parts(parts.y, row.repeat(n).reshape(n, n))
        return total

    _nrt_python.memsys_enable_stats()
    run(4)
    before = rtsys.get_allocation_stats()
    assert run(4) == 10 * 17.0
    after = rtsys.get_allocation_stats()
    _nrt_python.memsys_disable_stats()
    assert after.alloc - before.alloc == after.free - before.free > 0
