"""Entries: called by name and by address, and compiled once."""

from functools import partial
from types import FunctionType

import numpy as np
from numba import carray, njit, types
from numba.core.caching import FunctionCache
from pytensor.link.numba.cache import CACHED_SRC_FUNCTIONS

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.native import entry_point as entries
from pymc_statespace_filters.compiler.native.entry_point import (
    F64_PTR,
    EntryPoint,
    address_of,
    cached_on_disk,
    call_address,
)
from tests.systems import FORCE, FORCED_DATA, STEPS, forced

NATIVE = entries.__name__


def of_module(function, module):
    """The same function as if it were defined in a module."""
    return FunctionType(function.__code__, globals() | {"__name__": module})


def scale(x, n, factor):
    values = carray(x, (n,))
    for i in range(n):
        values[i] *= factor


ARGUMENTS = {"x": F64_PTR, "n": types.intp, "factor": types.float64}
SCALE = EntryPoint(scale, ARGUMENTS, "scale")
by_name, symbol = SCALE.external, SCALE.symbol


@njit
def twice(x):
    by_name(x.ctypes.data, x.size, 2.0)
    return x


@njit
def thrice(address, x):
    call_address(address, (x.ctypes.data, x.size, 3.0))
    return x


@njit
def of_a_temporary(address, n):
    out = np.ones(2 * n)
    call_address(address, (out[n:], n, 3.0))
    return out


@njit
def address():
    return address_of(symbol)


def test_is_called_by_name_and_by_address():
    SCALE.compile()
    assert twice(np.arange(3.0)).tolist() == [0, 2, 4]
    assert thrice(address(), np.arange(3.0)).tolist() == [0, 3, 6]
    assert njit(lambda: address_of(""))() == 0


def test_an_array_is_handed_over_by_its_address():
    SCALE.compile()
    assert of_a_temporary(address(), 2).tolist() == [1, 1, 3, 3]


def test_a_second_entry_under_the_same_key_is_the_first():
    one, two = (EntryPoint(of_module(scale, NATIVE), ARGUMENTS, "s") for _ in range(2))
    assert one.symbol == two.symbol
    other = EntryPoint(of_module(scale, NATIVE), ARGUMENTS, "s", ("text",))
    assert other.symbol != one.symbol


def with_constant(value):
    return lambda x: value


def test_an_entry_outside_the_package_has_no_key_and_a_part_from_there_that_of_its_code():
    for parts in ((), ("text",)):
        point = EntryPoint(scale, ARGUMENTS, "s", parts)
        assert point.key is None
        assert point.symbol != EntryPoint(scale, ARGUMENTS, "s", parts).symbol
    inside = of_module(scale, NATIVE)
    one, same, other = (EntryPoint(inside, ARGUMENTS, "s", (with_constant(c),)) for c in (1, 1, 2))
    assert one.key == same.key
    assert one.key != other.key
    mutable = with_constant([1.0])
    assert EntryPoint(inside, ARGUMENTS, "s", (mutable,)).key is None
    assert EntryPoint(inside, ARGUMENTS, "s", (None,)).key is None
    assert EntryPoint(inside, ARGUMENTS, "s", needs=(SCALE,)).key is None
    assert not isinstance(cached_on_disk(njit(scale), "text")._cache, FunctionCache)


def test_a_filter_is_compiled_once_for_all_systems_and_sizes():
    evaluate = partial(
        psf.log_likelihood, params={"a": 0.6}, observed=FORCED_DATA, steps=STEPS, inputs=FORCE
    )
    evaluate(forced(), psf.BootstrapPF(100))
    before = set(entries._compiled)
    evaluate(forced(), psf.BootstrapPF(200, resampling="multinomial"))
    assert set(entries._compiled) == before
    evaluate(forced(initial_mean=[0.25]), psf.BootstrapPF(100))
    assert set(entries._compiled) == before


def test_the_point_mass_filter_is_compiled_once_for_all_systems_and_tolerances():
    evaluate = partial(
        psf.log_likelihood, params={"a": 0.6}, observed=FORCED_DATA, steps=STEPS, inputs=FORCE
    )
    evaluate(forced(), psf.GridFilter())
    before = set(entries._compiled)
    evaluate(forced(), psf.GridFilter(tolerance=1e-6))
    assert set(entries._compiled) == before
    evaluate(forced(initial_mean=[0.35]), psf.GridFilter())
    assert set(entries._compiled) == before


def test_code_is_kept_for_its_module():
    """Kept code is loaded through its module: a file that moved must be compiled anew."""

    def function(x):
        return x + 1.0

    keys = []
    for module in (NATIVE, f"{psf.__name__}.errors"):
        moved = njit(of_module(function, module))
        keys.append(CACHED_SRC_FUNCTIONS[cached_on_disk(moved).py_func])
    assert keys[0] != keys[1]
