"""Closed libraries keep to themselves what other libraries might define otherwise."""

import math

import numpy as np
from llvmlite.binding import Linkage
from numba import njit

from pymc_statespace_filters.compiler.native.code_library import with_internal_linkage
from pymc_statespace_filters.compiler.native.entry_point import F64_PTR, EntryPoint, _compiled

_LINES = "\n".join(f"    total += math.sin({i} * x)" for i in range(300))
_NAMESPACE = {"math": math, "__name__": __name__}
exec(f"def long(x):\n    total = 0.0\n{_LINES}\n    return total", _NAMESPACE)
long = njit(_NAMESPACE["long"])  # too long to be pasted into its callers


def twice(x):
    return long(x) + long(x + 1.0)


def linkages_of_helpers(library):
    return [
        function.linkage
        for function in library._final_module.functions
        if "long" in function.name and not function.is_declaration
    ]


def test_functions_that_are_called_are_a_librarys_own():
    ordinary, kept_to_itself = njit(twice), with_internal_linkage(njit(twice))
    assert ordinary(0.5) == kept_to_itself(0.5)
    found = [
        linkages_of_helpers(next(iter(f.overloads.values())).library)
        for f in (ordinary, kept_to_itself)
    ]
    # Were numba to change, so that nothing is shared any more, the closed ones would not be needed.
    assert found == [[Linkage.linkonce_odr], [Linkage.internal]]


def test_entries_are_closed():
    def evaluate(out):
        out[0] = twice_jitted(out[0])

    twice_jitted = njit(twice)
    entry = EntryPoint(evaluate, {"out": F64_PTR}, "evaluate", None)
    entry.compile()
    assert linkages_of_helpers(_compiled[entry.symbol]._library) == [Linkage.internal]
    result = np.array([0.5])
    _compiled[entry.symbol].ctypes(
        result.ctypes.data_as(_compiled[entry.symbol].ctypes.argtypes[0])
    )
    assert result[0] == twice_jitted(0.5)
