"""Entry points: machine code compiled once, cached on disk, called by symbol or address.

Numba copies an ordinary callee into its caller and optimises it again there, at every level of
callers, so a filter would be compiled again for each model and each number of members. The callers
of an entry point refer to its symbol only, which is the same in every process. A filter is
therefore compiled once per installation, and a model once for all filters.

Arguments of an entry point are numbers and addresses of contiguous float64 or int64 data.
"""

import os
from collections import namedtuple
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from inspect import signature
from pathlib import Path
from typing import Any
from uuid import uuid4

import llvmlite.binding as llvm
from filelock import FileLock
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.caching import FunctionCache
from numba.core.ccallback import CFunc
from numba.core.compiler_lock import global_compiler_lock
from numba.core.errors import NumbaError
from numba.extending import intrinsic
from pytensor import config
from pytensor.link.numba.cache import CACHED_SRC_FUNCTIONS

from ...errors import ModelError
from ...parallel.signals import held_interrupts
from ...progress import slow_compilation
from .cache_key import is_outside, key_of
from .code_library import InternalLinkageCompiler, with_internal_linkage
from .jit import FAST_MATH
from .shipped_code import shipped_for

F64_PTR = types.CPointer(types.float64)
I64_PTR = types.CPointer(types.int64)

PATIENCE = 300.0  # seconds, with another process that compiles the same function


class _CacheByKey(FunctionCache):
    """A cache in PyTensor's folder that compares the key alone, and compiles anew what is damaged.

    Numba would also compare the closure, and compiled functions in it differ in every process.
    What is not in the folder may have come with the package.
    """

    def load_overload(self, sig, target_context):
        found = None
        try:
            found = super().load_overload(sig, target_context)
        except Exception:  # whatever unpickling half a file raises, at every start again
            self.flush()
        return found or self._shipped(sig, target_context)

    def is_there(self, target_context) -> bool:
        """Whether there are files of the function, in the folder or with the package."""
        if os.path.exists(self._cache_file._index_path):
            return True
        code = shipped_for(target_context.codegen().magic_tuple())
        return code is not None and self._cache_file._index_name in code.checksums

    def _shipped(self, signature, context):
        code = shipped_for(context.codegen().magic_tuple())
        if code is None:
            return None
        content = code.load(self._impl.filename_base, self._index_key(signature, code))
        return content and self._impl.rebuild(context, content)

    def _index_key(self, signature, codegen):
        return signature, codegen.magic_tuple(), CACHED_SRC_FUNCTIONS[self._py_func]


# Keeps the Python objects, and with them their machine code, alive.
_compiled: dict[str, Any] = {}


def cached_on_disk(function: Any, *parts: str | None) -> Any:
    """Cache a jitted function of this package in PyTensor's folder.

    ``parts`` identify what it closes over, see `key_of`; without a key it is not cached.
    """
    key = key_of(function.__module__, function.__qualname__, *parts)
    if key is not None and config.numba__cache:
        function._cache = _cache(function.py_func, key)
    return with_internal_linkage(function)


def njit_cached(function: Callable) -> Any:
    """Compile a function of this package that Python calls; for the next process from disk."""
    return cached_on_disk(njit(function, error_model="numpy", nogil=True, no_cfunc_wrapper=True))


def _cache(function: Callable, key: str) -> _CacheByKey:
    CACHED_SRC_FUNCTIONS[function] = key
    return _CacheByKey(function)


@contextmanager
def _one_process(compiled: Any) -> Iterator[None]:
    """Have one process compile what is not kept yet; the others wait, and find its file.

    The lock is the operating system's: it ends with its process, however that ends. Without it
    processes compile the same function, each for itself: where the folder has no locks or cannot be
    written, and where the owner of the lock takes longer than `PATIENCE`.
    """
    cache = compiled._cache
    if not isinstance(cache, _CacheByKey) or cache.is_there(compiled._targetdescr.target_context):
        yield
        return
    path = Path(f"{cache._cache_file._index_path}.lock")
    # Numba's lock first: a thread has it while it compiles, and may then come to other functions.
    with global_compiler_lock, ExitStack() as stack:
        with suppress(OSError):
            stack.enter_context(FileLock(path, PATIENCE, fallback_to_soft=False))
            stack.callback(_remove, path)
        yield


def _remove(path: Path) -> None:
    with suppress(OSError):  # on Windows a file that is open cannot be removed
        path.unlink()


class EntryPoint:
    """A function that `compile` compiles on its first call, and that is called by its ``symbol``.

    The function raises nothing, and may close over compiled functions: ``parts`` identify these,
    see `key_of`, as its module is covered by itself. ``needs`` are what it calls by symbol, and
    ``name`` is the part of its own that is readable in a profile. Names and order of the
    ``arguments``, with their numba types, are checked, because machine code would read one argument
    as another; ``F64_PTR`` and ``I64_PTR`` are addresses, of which ``numba.carray`` makes arrays.
    """

    def __init__(
        self,
        function: Callable,
        arguments: Mapping[str, Any],
        name: str,
        parts: Sequence[str | Callable | None] = (),
        needs: Sequence["EntryPoint"] = (),
        returns: Any = types.void,
    ):
        if (parameters := list(signature(function).parameters)) != list(arguments):
            raise TypeError(
                f"the arguments of entry point {name!r} must be {parameters}, the parameters of "
                f"its function, got {list(arguments)}"
            )
        self._function = function
        self._name = name
        self._arguments = tuple(arguments.values())
        self._needs, self._returns = needs, returns
        self._parts = parts, [needed.key for needed in needs]
        self.key: str | None = self._key()
        self.symbol = f"psf_{name}_{self.key or uuid4().hex}"

    def _key(self) -> str | None:
        parts, keys = self._parts
        return key_of(self._function.__module__, self._name, *parts, *keys)

    def compile(self) -> None:
        """Define the symbol in this process; load it from disk if it was compiled before.

        Raises `ModelError` if something that a user's function refers to is not what it was when
        this was made, or numba cannot compile it.
        """
        parts, _ = self._parts
        if self._key() != self.key:
            raise ModelError(
                f"the functions of {self._name!r} refer to something that has changed since they "
                "were given; give them again, by the lines that define the filter"
            )
        if self.symbol in _compiled:
            return
        for needed in self._needs:
            needed.compile()
        compiled = self._callback()
        with slow_compilation(self._name), _one_process(compiled):
            try:
                with held_interrupts():  # LLVM calls Python, where an interrupt would be lost
                    compiled.compile()
            except NumbaError as error:
                if outside := [f for f in parts if callable(f) and is_outside(f)]:
                    raise ModelError(_explained(self._name, outside, error)) from error
                raise
        llvm.add_symbol(self.symbol, compiled.address)
        _compiled[self.symbol] = compiled

    def _callback(self) -> Any:
        """Numba's object of the function, before it is compiled or loaded."""
        options = {"nopython": True, "error_model": "numpy", "fastmath": FAST_MATH}
        compiled: Any = CFunc(
            self._function,
            (self._arguments, self._returns),
            {},
            options,
            pipeline_class=InternalLinkageCompiler,
        )
        if self.key is not None and config.numba__cache:
            compiled._cache = _cache(self._function, self.key)
        return compiled

    @property
    def is_compiled(self) -> bool:
        """Whether it was compiled before: in this process, on disk, or with the package."""
        if self.symbol in _compiled:
            return True
        for needed in self._needs:  # whose symbols it refers to when it is loaded
            if not needed.is_compiled:
                return False
            needed.compile()
        found = self._callback()
        return bool(found._cache.load_overload(found._sig, found._targetdescr.target_context))

    @property
    def address(self) -> int:
        """Address of the compiled code."""
        return _compiled[self.symbol].address

    @property
    def external(self) -> types.ExternalFunction:
        """The function for use in compiled functions; addresses are passed as integers."""
        pointer = types.CPointer
        arguments = (types.intp if isinstance(a, pointer) else a for a in self._arguments)
        return types.ExternalFunction(self.symbol, self._returns(*arguments))


def _explained(name: str, functions: Sequence[Any], error: NumbaError) -> str:
    """Which of a user's functions numba cannot compile, or else what they return."""
    lines = [line for line in str(error).splitlines() if not line.startswith("Failed in")]
    returned = []
    for function in functions:
        if f"<function {function.__qualname__} at" in str(error):
            return f"numba cannot compile {function.__name__} of {name!r}: {lines[0]}"
        for found in function.nopython_signatures[-1:]:  # none if it was not reached
            returned.append(f"{function.__name__} returns {found.return_type}")
    return f"the functions of {name!r} do not fit, {', '.join(returned)}: {lines[0]}"


def arguments_class(name: str, arguments: Mapping[str, Any], module: str) -> Any:
    """Make the named tuple with which a caller gives the arguments of an entry point by name."""
    return namedtuple(name, list(arguments), module=module)


@intrinsic(prefer_literal=True)
def address_of(typing_context, symbol):
    """Address of the entry point with this symbol, a literal string; 0 for the empty string."""

    def generate(context, builder, signature, values):
        integer = context.get_value_type(types.intp)
        if not symbol.literal_value:
            return integer(0)
        kind = ir.FunctionType(ir.VoidType(), [])
        function = cgutils.get_or_insert_function(builder.module, kind, symbol.literal_value)
        return builder.ptrtoint(function, integer)

    return types.intp(symbol), generate


@intrinsic
def pointer(typing_context, address):
    """An integer as an address, of which ``numba.carray`` makes an array."""

    def generate(context, builder, signature, values):
        return builder.inttoptr(values[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


def _caller(returns: Any) -> Any:
    """A function that calls an entry point with this type of result."""

    @intrinsic
    def call(typing_context, address, arguments):
        def generate(context, builder, signature, values):
            kinds = signature.args[1]
            given = list(cgutils.unpack_tuple(builder, values[1]))
            for i, kind in enumerate(kinds):
                if isinstance(kind, types.Array):
                    given[i] = context.make_array(kind)(context, builder, given[i]).data
            result = ir.VoidType() if returns == types.void else context.get_value_type(returns)
            function = ir.FunctionType(result, [value.type for value in given])
            returned = builder.call(builder.inttoptr(values[0], function.as_pointer()), given)
            return context.get_dummy_value() if returns == types.void else returned

        return returns(types.intp, arguments), generate

    return call


call_address = _caller(types.void)
"""Call the entry point at an address with a tuple of numbers, addresses and arrays.

An array is passed by address and stays alive until the call.
"""

call_for_status = _caller(types.int64)
"""Call an entry point that returns a status."""
