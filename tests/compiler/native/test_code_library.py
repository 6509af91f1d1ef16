"""Closed libraries keep to themselves what other libraries might define otherwise."""

import gc
import math
from typing import NamedTuple

import numpy as np
import pytest
from llvmlite.binding import Linkage
from numba import njit
from numba.core.codegen import JITCodeLibrary
from numba.core.runtime import _nrt_python, rtsys

from pymc_statespace_filters.compiler.native import code_library
from pymc_statespace_filters.compiler.native.code_library import with_internal_linkage
from pymc_statespace_filters.compiler.native.entry_point import F64_PTR, EntryPoint, _compiled
from pymc_statespace_filters.compiler.native.jit import inlined, njit_internal

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
    entry = EntryPoint(evaluate, {"out": F64_PTR}, "evaluate")
    entry.compile()
    assert linkages_of_helpers(_compiled[entry.symbol]._library) == [Linkage.internal]
    result = np.array([0.5])
    _compiled[entry.symbol].ctypes(
        result.ctypes.data_as(_compiled[entry.symbol].ctypes.argtypes[0])
    )
    assert result[0] == twice_jitted(0.5)


def test_what_only_compiled_functions_call_has_no_machine_code():
    """It is optimised, linked into its callers with all that it calls, and refuses Python."""

    @njit_internal
    def innermost(x):
        total = 0.0
        for i in range(100):
            total += math.sin(i * x)
        return total

    @inlined
    def inner(x):
        return innermost(x) + 1.0

    @njit_internal
    def outer(x):
        return inner(x) + inner(2.0 * x)

    called = njit(lambda x: outer(x))
    expected = sum(math.sin(i * 0.3) + math.sin(i * 0.6) for i in range(100)) + 2.0
    assert abs(called(0.3) - expected) < 1e-12
    for function in (innermost, inner, outer):
        (compiled,) = function.overloads.values()
        assert not compiled.library._compiled
        with pytest.raises(TypeError, match="not callable"):
            function(0.3)


def test_what_is_inlined_twice_over_is_linked():
    """`inner` comes by way of `beside` before it comes by way of `middle`, which needs it."""

    @inlined
    def inner(x):
        return math.sin(x)

    @njit_internal
    def beside(x):
        return inner(x)

    @inlined
    def middle(x):
        return inner(x) + 1.0

    @njit_internal
    def outer(x):
        return beside(x) + middle(x)

    @njit_internal
    def outermost(x):
        return inner(x) + outer(x)

    called = njit(lambda x: outermost(x))
    assert abs(called(0.3) - 3.0 * math.sin(0.3) - 1.0) < 1e-12


def test_a_function_is_optimised_once_however_many_call_it(monkeypatch):
    optimised = []
    optimise = code_library.JITCodeLibrary._optimize_final_module
    monkeypatch.setattr(
        code_library.JITCodeLibrary,
        "_optimize_final_module",
        lambda self: (optimised.append(type(self).__name__), optimise(self))[1],
    )

    @njit_internal
    def shared(x):
        return math.sin(x) * x

    @njit_internal
    def first(x):
        return shared(x) + 1.0

    @njit_internal
    def second(x):
        return shared(x) + first(x)

    def evaluate(out):
        out[0] = first(out[0]) + second(out[0])

    EntryPoint(evaluate, {"out": F64_PTR}, "evaluate_once").compile()
    assert optimised.count("_LinkedLibrary") == 3
    assert optimised.count("_InternalLinkageLibrary") == 1


class Pair(NamedTuple):
    first: np.ndarray
    second: np.ndarray


def exchanged(pair):
    turned = Pair(pair.second, pair.first.copy())
    return Pair(turned.second, turned.first)


@pytest.fixture
def counted_memory():
    _nrt_python.memsys_enable_stats()
    yield
    _nrt_python.memsys_disable_stats()


@pytest.mark.usefixtures("counted_memory")
def test_of_tuples_only_the_owners_of_memory_are_taken(monkeypatch):
    counts = []
    add = JITCodeLibrary.add_ir_module

    def counted(self, module):
        counts.append(str(module).count(" = extractvalue "))
        return add(self, module)

    monkeypatch.setattr(JITCodeLibrary, "add_ir_module", counted)
    pair = Pair(np.arange(3.0), np.ones(2))
    for function in (njit(exchanged), with_internal_linkage(njit(exchanged))):
        first = len(counts)
        before = rtsys.get_allocation_stats()
        result = function(pair)
        np.testing.assert_array_equal(result.first, pair.first)
        np.testing.assert_array_equal(result.second, pair.second)
        del result
        after = rtsys.get_allocation_stats()
        assert after.alloc - before.alloc == after.free - before.free
        counts[first:] = [sum(counts[first:])]
    ordinary, own = counts
    assert own < 0.7 * ordinary


def test_garbage_collection_pauses_during_a_compilation_and_is_left_as_it_was(monkeypatch):
    during = []
    compile_extra = code_library.Compiler.compile_extra

    def observed(self, function):
        during.append(gc.isenabled())
        return compile_extra(self, function)

    monkeypatch.setattr(code_library.Compiler, "compile_extra", observed)
    with_internal_linkage(njit(lambda x: x + 1.0))(0.5)
    assert gc.isenabled()
    gc.disable()
    try:
        with_internal_linkage(njit(lambda x: x + 2.0))(0.5)
        assert not gc.isenabled()
    finally:
        gc.enable()
    assert during == [False, False]
