"""PyTensor functions called by address: the same numbers, whatever the types, and no exception."""

import gc
import sys

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest
from numba import njit
from pytensor.graph.basic import Apply
from pytensor.graph.op import Op

from pymc_statespace_filters.compiler.native.pytensor_function import (
    NativeFunction,
    _adapter,
    make_call,
)


@njit
def call(bound):
    return make_call(bound)


@njit
def call_often(bound, n):
    total = 0.0
    for _ in range(n):
        make_call(bound)
        total += bound.out[1]
    return total


def compiled(inputs, outputs, mode="NUMBA"):
    function = pytensor.function(inputs, outputs, mode=mode)
    function.trust_input = True
    return function


def flat(results):
    return np.concatenate([np.ravel(result) for result in results])


@pytest.mark.parametrize("mode", ["NUMBA", "FAST_COMPILE"])
def test_inputs_data_and_results_of_all_kinds(mode):
    """Numbers, vectors and matrices; float64, int64, bool and float32; shared data."""
    rng = np.random.default_rng(0)
    x, k, flag, m = pt.dvector("x"), pt.lscalar("k"), pt.bscalar("flag"), pt.fmatrix("m")
    shared = pytensor.shared(np.asfortranarray(rng.normal(size=(3, 4))))
    # A row of data in another order; no sums and products, which numba takes seconds to compile.
    outputs = [x[0] * shared[1], k * 2, pt.eq(flag, 1), 3 * m[1], pt.exp(x[0])]
    function = compiled([x, k, flag, m], outputs, mode)
    inputs = [
        rng.normal(size=3),
        np.array(7),
        np.array(1, dtype=np.int8),
        rng.normal(size=(2, 5)).astype(np.float32),
    ]
    native = NativeFunction(function, inputs)
    assert [shape for shape, _ in native.kinds] == [(4,), (), (), (5,), ()]
    assert native.size == 12
    bound, kept = native.bind(inputs)
    for _ in range(3):
        assert call(bound)
        np.testing.assert_allclose(bound.out[1:], flat(function(*inputs)), rtol=1e-14)
        for array in inputs:  # the call reads the arrays as they are now
            array[...] = array + 1
    assert kept


def test_the_data_are_those_of_the_beginning():
    data = pytensor.shared(np.array([1.0, 2.0]))
    x = pt.dscalar("x")
    function = compiled([x], [x * data.sum()])
    at = np.array(2.0)
    before, kept = NativeFunction(function, [at]).bind([at])
    data.set_value(np.array([10.0, 20.0, 30.0]))
    after, also_kept = NativeFunction(function, [at]).bind([at])
    assert call(before)
    assert call(after)
    assert (before.out[1], after.out[1]) == (6.0, 120.0)
    assert kept is not also_kept


def test_functions_of_equal_types_share_an_adapter():
    x = pt.dvector("x")
    at = np.ones(2)
    first = NativeFunction(compiled([x], [x.sum()]), [at]).bind([at])[0]
    n_adapters = _adapter.cache_info().currsize
    second = NativeFunction(compiled([x], [x.prod() + 4.0]), [at]).bind([at])[0]
    assert _adapter.cache_info().currsize == n_adapters
    assert first.table[0] == second.table[0]
    assert first.table[1] != second.table[1]
    assert call(first)
    assert call(second)
    assert (first.out[1], second.out[1]) == (2.0, 5.0)


@pytest.mark.parametrize("mode", ["NUMBA", "FAST_COMPILE"])
def test_an_exception_is_a_status(mode):
    x, n = pt.dvector("x"), pt.lscalar("n")
    function = compiled([x, n], [x[n]], mode)
    inputs = [np.array([1.0, 2.0]), np.array(1)]
    native = NativeFunction(function, inputs)
    bound, _ = native.bind(inputs)
    assert call(bound)
    assert bound.out[1] == 2.0
    inputs[1][...] = 5
    assert not call(bound)
    with pytest.raises(IndexError):
        native(*inputs)
    inputs[1][...] = 0
    assert call(bound)
    assert bound.out[1] == 1.0


class Negative(Op):
    """An operation that numba does not know."""

    __props__ = ()

    def make_node(self, x):
        return Apply(self, [x], [x.type()])

    def perform(self, node, inputs, output_storage):
        output_storage[0][0] = np.asarray(-inputs[0])


def test_an_operation_that_needs_python():
    x = pt.dvector("x")
    at = np.array([1.0, -2.0])
    with pytest.warns(UserWarning, match="object mode"):
        native = NativeFunction(compiled([x], [Negative()(x)]), [at])
    bound, _ = native.bind([at])
    assert call(bound)
    np.testing.assert_array_equal(bound.out[1:], [-1.0, 2.0])


def test_results_are_released():
    """Two thousand results of a megabyte each would be noticed."""
    resource = pytest.importorskip("resource")  # Windows has no such module
    unit = 1 if sys.platform == "darwin" else 1024  # bytes
    x = pt.dvector("x")
    at = np.ones(125_000)
    bound, _ = NativeFunction(compiled([x], [x * 2.0]), [at]).bind([at])
    call_often(bound, 100)
    gc.collect()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    call_often(bound, 2000)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown * unit < 1e8
