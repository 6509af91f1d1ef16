"""Compiled PyTensor functions that machine code can call without Python.

A PyTensor function is machine code already, with arrays as arguments and results. A table of
addresses describes a call: an adapter makes arrays of them, calls the function by its address, and
writes all results one after the other into a float64 vector. Adapters depend on the types alone, so
a second function of the same types needs no compilation.
"""

import ctypes
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import cache
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from numba import carray, njit, typeof, types
from numba.core import cgutils
from numba.extending import intrinsic

from ...parallel.signals import held_interrupts
from ...progress import slow_compilation
from .code_library import with_internal_linkage
from .entry_point import F64_PTR, I64_PTR, EntryPoint, call_address, pointer
from .python_call import call_machine_code

_N_ADDRESSES = 2  # of adapter and function, before those of the inputs


class Call(NamedTuple):
    """Arguments and results of a call from machine code, for one thread at a time.

    ``table`` has the addresses of the adapter, of the function and of its inputs; the inputs'
    shapes; and the length of ``out``. This (1 + n,) is first 0, or 1 if the function raised; then
    the results, one after the other.
    """

    table: np.ndarray
    out: np.ndarray


@njit(error_model="numpy", nogil=True, inline="always")
def make_call(call):
    """Make the call; returns whether it succeeded."""
    call_address(call.table[0], (call.table, call.out))
    return call.out[0] == 0.0


class NativeFunction:
    """A compiled PyTensor function whose inputs and outputs are arrays of numbers.

    ``example`` holds the inputs of a first call, which determines ``kinds``, shape and dtype, of
    the results. In PyTensor's modes without numba, or if it has a state to update, as of a
    generator, machine code calls Python instead. ``errors`` surrounds every call from Python.
    """

    def __init__(
        self,
        function: Any,
        example: Sequence[np.ndarray],
        errors: Callable[[], AbstractContextManager] = nullcontext,
    ):
        self._function, self._errors = function, errors
        # PyTensor functions have one storage for all threads.
        self._one_at_a_time = Lock()
        self.example = [np.require(value, requirements=("C", "W")) for value in example]
        shared = [cell.storage[0] for cell in function.input_storage[len(example) :]]
        has_updates = len(function.maker.fgraph.outputs) > len(function.maker.outputs)
        self.is_native = (
            hasattr(function.vm, "jit_fn")
            and not has_updates
            and all(isinstance(value, np.ndarray) and value.dtype.kind in "bif" for value in shared)
        )
        if self.is_native:
            with_internal_linkage(function.vm.jit_fn)
        # Current values of shared variables, in the memory layout of the adapters.
        self._data = [np.array(v, order="C") for v in shared] if self.is_native else []
        with held_interrupts(), slow_compilation("the functions of the model"):
            results = [np.asarray(result) for result in self(*self.example)]
        self.kinds = [(result.shape, result.dtype) for result in results]

    @property
    def size(self) -> int:
        """Total number of elements of the results."""
        return sum(int(np.prod(shape)) for shape, _ in self.kinds)

    def __call__(self, *inputs: np.ndarray) -> Sequence[np.ndarray]:
        """Call from Python."""
        with self._errors():
            if self.is_native:
                return call_machine_code(self._function.vm.jit_fn, *inputs, *self._data)
            with self._one_at_a_time:
                return self._function(*inputs)

    def bind(self, inputs: Sequence[np.ndarray]) -> tuple[Call, Callable[[], object]]:
        """A call that reads these contiguous arrays, and a function that repeats it from Python.

        The function raises the exception of the call, and holds its memory: keep it as long.
        """
        out = np.zeros(1 + self.size)
        if not self.is_native:
            callback = self._callback(inputs, out)
            address = ctypes.cast(callback, ctypes.c_void_p).value
            call = Call(np.array([address], dtype=np.int64), out)
            return call, lambda _memory=callback: self(*inputs)
        arrays = [*inputs, *self._data]
        kinds = types.Tuple([typeof(array) for array in arrays])
        overloads = self._function.vm.jit_fn.overloads
        # PyTensor functions take a tuple if they are cached on disk, else separate arguments.
        signature = (kinds,) if (kinds,) in overloads else kinds.types
        compiled = overloads[signature]
        addresses = [
            _adapter(kinds, signature, compiled.fndesc.restype),
            compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name),
            *(array.ctypes.data for array in arrays),
        ]
        lengths = [length for array in arrays for length in array.shape]
        call = Call(np.array([*addresses, *lengths, out.size], dtype=np.int64), out)
        return call, lambda: self(*inputs)

    def _callback(self, inputs: Sequence[np.ndarray], out: np.ndarray) -> Any:
        def evaluate(table: int, results: int) -> None:
            out[0] = 1.0
            # An exception cannot pass through machine code; the caller sees the 1 and calls again.
            with suppress(Exception):
                values = self(*inputs)
                out[1:] = np.concatenate([np.ravel(value) for value in values])
                out[0] = 0.0

        return ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(evaluate)


@cache
def _adapter(arguments: types.BaseTuple, signature: tuple, results: types.BaseTuple) -> int:
    """Compile the adapter of these types, from a table of addresses to a call; its address."""
    namespace: dict[str, Any] = {"__name__": __name__, "carray": carray, "pointer": pointer}
    namespace["invoke"] = _invoker(signature, results)
    arrays, n_table = "", _N_ADDRESSES + len(arguments)
    for i, kind in enumerate(arguments):
        namespace[f"dtype_{i}"] = np.dtype(str(kind.dtype))
        lengths = "".join(f"of[{n_table + axis}], " for axis in range(kind.ndim))
        arrays += f"carray(pointer(of[{_N_ADDRESSES + i}]), ({lengths}), dtype_{i}), "
        n_table += kind.ndim
    lines = [
        f"of = carray(table, ({n_table + 1},))",
        f"numbers = carray(out, (of[{n_table}],))",
        f"raised, results = invoke(of[1], ({arrays}))",
        "numbers[0] = raised",
        "if raised:",
        "    return",
        "n = 1",
    ]
    for i, kind in enumerate(results):
        if kind.ndim:
            lines += [f"for value in results[{i}].flat:", "    numbers[n] = value", "    n += 1"]
        else:
            lines += [f"numbers[n] = results[{i}].item()", "n += 1"]
    source = "def adapter(table, out):\n" + "".join(f"    {line}\n" for line in lines)
    exec(compile(source, "<adapter of a PyTensor function>", "exec"), namespace)
    parts = (source, str(signature), str(results))
    entry = EntryPoint(namespace["adapter"], {"table": I64_PTR, "out": F64_PTR}, "adapter", parts)
    entry.compile()
    return entry.address


def _forget_error(context: Any, builder: Any) -> None:
    """Clear Python's error indicator, which a failed operation in Python has set."""
    python = context.get_python_api(builder)
    lock = python.gil_ensure()
    python.err_clear()
    python.gil_release(lock)


def _invoker(signature: tuple, results: types.BaseTuple) -> Any:
    """An intrinsic that calls the numba function at an address: (raised, results)."""

    @intrinsic
    def invoke(typing_context, address, arguments):
        def generate(context, builder, _, values):
            given = [values[1]]
            if signature != (arguments,):
                given = list(cgutils.unpack_tuple(builder, values[1]))
            convention = context.call_conv
            kind = convention.get_function_type(results, signature)
            function = builder.inttoptr(values[0], kind.as_pointer())
            # After an exception the results are null arrays, which are safe to release.
            status, returned = convention.call_function(
                builder, function, results, signature, given
            )
            with builder.if_then(status.is_error, likely=False):
                _forget_error(context, builder)
            return context.make_tuple(builder, outcome, (status.is_error, returned))

        outcome = types.Tuple((types.boolean, results))
        return outcome(types.int64, arguments), generate

    return invoke
