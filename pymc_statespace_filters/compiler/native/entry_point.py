"""Machine code with a name: compiled once, kept on disk, and called through a symbol or an address.

A function that another compiled function calls in the ordinary way is copied into its caller and
optimised again there, at every level of callers: a filter would be compiled anew for each model and
for each number of members. An entry is not: its callers hold its name, which is the same in every
process. So a filter is compiled once per installation, and a model once for all filters.

Arguments of an entry are numbers and addresses of contiguous float64 or int64 data.
"""

from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from typing import Any
from uuid import uuid4

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.caching import FunctionCache
from numba.core.ccallback import CFunc
from numba.extending import intrinsic
from pytensor import config
from pytensor.link.numba.cache import CACHED_SRC_FUNCTIONS

from pymc_statespace_filters.compiler.native.cache_key import FAST_MATH, digest
from pymc_statespace_filters.compiler.native.private_linkage import (
    InternalLinkageCompiler,
    with_internal_linkage,
)

F64_PTR = types.CPointer(types.float64)
I64_PTR = types.CPointer(types.int64)


class _CacheByKey(FunctionCache):
    """A cache in PyTensor's folder that asks for the key alone.

    Numba would also compare what the function closes over, and compiled functions are never the
    same in two processes.
    """

    def _index_key(self, signature, codegen):
        return signature, codegen.magic_tuple(), CACHED_SRC_FUNCTIONS[self._py_func]


# Machine code lives as long as its Python object.
_compiled: dict[str, Any] = {}


def cached_on_disk(function: Any, key: str) -> Any:
    """Keep a compiled function on PyTensor's disk cache, under a key that identifies its code."""
    if config.numba__cache:
        function._cache = _cache(function.py_func, key)
    return with_internal_linkage(function)


def _cache(function: Callable, key: str) -> _CacheByKey:
    # What is kept is loaded by way of its module, which may be another one tomorrow.
    CACHED_SRC_FUNCTIONS[function] = digest(key, function.__module__)
    return _CacheByKey(function)


class EntryPoint:
    """A function that is compiled when `compile` is first called, and called by its ``symbol``.

    Parameters
    ----------
    function : callable
        Returns nothing and raises nothing. It may close over compiled functions.
    arguments : mapping of str to numba type
        The parameters of the function, by name and in order. ``F64_PTR`` and ``I64_PTR`` are
        addresses, of which ``numba.carray`` makes arrays.
    name : str
        Part of the symbol, for the reader of a profile.
    key : str or None
        Identifies the code, see `digest`; None if it cannot be cached on disk.
    needs : sequence of EntryPoint
        What the function calls by symbol.

    Raises
    ------
    TypeError
        If the names or the order of the arguments are not those of the function: machine code
        would read one argument as another.
    """

    def __init__(
        self,
        function: Callable,
        arguments: Mapping[str, Any],
        name: str,
        key: str | None,
        needs: Sequence["EntryPoint"] = (),
    ):
        if (parameters := list(signature(function).parameters)) != list(arguments):
            raise TypeError(
                f"the arguments of entry point {name!r} must be {parameters}, the parameters of "
                f"its function, got {list(arguments)}"
            )
        self._function = function
        self._arguments = tuple(arguments.values())
        self._needs = needs
        self.key = key
        self.symbol = f"psf_{name}_{key or uuid4().hex}"

    def compile(self) -> None:
        """Make the symbol known to this process, from disk if any process compiled it before."""
        if self.symbol in _compiled:
            return
        for needed in self._needs:
            needed.compile()
        options = {"nopython": True, "error_model": "numpy", "fastmath": FAST_MATH}
        compiled: Any = CFunc(
            self._function,
            (self._arguments, types.void),
            {},
            options,
            pipeline_class=InternalLinkageCompiler,
        )
        if self.key is not None and config.numba__cache:
            compiled._cache = _cache(self._function, self.key)
        compiled.compile()
        llvm.add_symbol(self.symbol, compiled.address)
        _compiled[self.symbol] = compiled

    @property
    def address(self) -> int:
        """Where the compiled code lies."""
        return _compiled[self.symbol].address

    @property
    def external(self) -> types.ExternalFunction:
        """The function for use in compiled functions; addresses are passed as integers."""
        pointer = types.CPointer
        arguments = (types.intp if isinstance(a, pointer) else a for a in self._arguments)
        return types.ExternalFunction(self.symbol, types.void(*arguments))


def arguments_class(name: str, arguments: Mapping[str, Any], module: str) -> Any:
    """Make the named tuple with which a caller gives the arguments of an entry point by name."""
    return namedtuple(name, list(arguments), module=module)


@intrinsic(prefer_literal=True)
def address_of(typing_context, symbol):
    """Address of the entry with this symbol, a literal string; 0 for the empty string."""

    def generate(context, builder, signature, values):
        integer = context.get_value_type(types.intp)
        if not symbol.literal_value:
            return integer(0)
        kind = ir.FunctionType(ir.VoidType(), [])
        function = cgutils.get_or_insert_function(builder.module, kind, symbol.literal_value)
        return builder.ptrtoint(function, integer)

    return types.intp(symbol), generate


@intrinsic
def call_address(typing_context, address, arguments):
    """Call the entry at an address with a tuple of numbers, addresses, and arrays.

    Of an array the entry gets the address; unlike one whose address was taken, it lives until then.
    """

    def generate(context, builder, signature, values):
        kinds = signature.args[1]
        given = list(cgutils.unpack_tuple(builder, values[1]))
        for i, kind in enumerate(kinds):
            if isinstance(kind, types.Array):
                given[i] = context.make_array(kind)(context, builder, given[i]).data
        function = ir.FunctionType(ir.VoidType(), [value.type for value in given])
        builder.call(builder.inttoptr(values[0], function.as_pointer()), given)
        return context.get_dummy_value()

    return types.void(types.intp, arguments), generate
