"""A function that a plan computes: called from Python, or by machine code that numba compiles."""

from array import array
from collections.abc import Callable, Sequence
from ctypes import addressof, c_char
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import _empty_nd_impl, populate_array

from ...errors import ModelError
from .cache_key import key_of
from .plan import (
    ARGUMENTS,
    DEFAULTS,
    HEADER,
    N_RECORD,
    N_REQUEST,
    N_RESULTS,
    RAISED,
    RECORD,
    REQUEST,
    RESULTS,
    SHAPES,
    Argument,
    Plan,
    PlanFunction,
    Refusal,
)

type Names = Sequence[tuple[str, int]]

# The vectors of a call lie one behind the other.
_FIRST = {"record": 0, "request": N_RECORD, "results": N_RECORD + N_REQUEST}
_N_WORDS = N_RECORD + N_REQUEST + N_RESULTS
_BYTES = 8
_NOTHING = c_char * 0
_RESULTS = _FIRST["results"]

_DEFAULT_WORDS = array("q", [0] * _N_WORDS)
for _vector, _words in DEFAULTS.items():
    for _slot, _word in _words.items():
        _DEFAULT_WORDS[_FIRST[_vector] + _slot] = _word
# Sizes that are those of an argument; other results need a call that asks for their sizes.
_WORDS_OF_SIZES = {
    RESULTS.n_terms: RECORD.n_rows,
    RESULTS.n_theta: RECORD.n_theta,
    RESULTS.n_records: RECORD.n_records,
    RESULTS.n_wanted: _FIRST["request"] + REQUEST.n_wanted,
}
_SIZES_ONLY = _FIRST["request"] + REQUEST.sizes_only
_REPLACEMENT = _FIRST["request"] + REQUEST.replacement


def _exception(status: int) -> type[Exception]:
    return RuntimeError if status == RAISED else ModelError


def refusal(status: int) -> Exception:
    """What the status of a call says."""
    return _exception(status)(Refusal.of(status).message)


class BoundCall(NamedTuple):
    """A call of a plan with its memory, for `composed_call`.

    ``places`` are those of numbers that are passed by value, among the words, None for arrays.
    """

    plan: int
    words: array
    results: list[np.ndarray]
    places: list[int | None]
    arguments: Sequence[Any]  # alive as long as the call


def _vectors(words: array) -> tuple[int, int, int]:
    """The addresses of record, request and results."""
    record, _ = words.buffer_info()
    return record, record + _BYTES * N_RECORD, record + _BYTES * _RESULTS


class PlannedFunction:
    """A compiled function of arrays and numbers, of which a plan is the machine code.

    Arguments and results have names and dimensions, see `plan.ARGUMENTS` and `plan.SHAPES`; a
    single result is returned as it is.
    """

    def __init__(self, plan: Plan, arguments: Names, results: Names) -> None:
        self.plan = plan
        self.arguments, self.results = tuple(arguments), tuple(results)
        self._given = [ARGUMENTS[argument] for argument in self.arguments]
        self._places = [_words_of(argument) for argument in self._given]
        self._shapes = [_shape(name, ndim) for name, ndim in results]
        sizes = {s for _, shape in self._shapes for s, is_slot in shape if is_slot}
        self._asks_for_sizes = not sizes <= _WORDS_OF_SIZES.keys()
        names = [name for name, _ in results]
        self._tape = names.index("tape") if "tape" in names else None

    @property
    def key(self) -> str | None:
        """Identifies the code; None if it cannot be cached on disk."""
        return key_of(__name__, repr((self.arguments, self.results)), self.plan.key)

    def loaded(self) -> "PlannedFunction":
        """Compile or load the functions of the plan now, not in the first call."""
        self.plan.load()
        return self

    def __call__(self, *values: Any) -> Any:
        """Call from Python; arrays are contiguous and of the right types."""
        given = _arrays(values)  # alive until the call has ended
        words, made = self._prepared(given)
        run = self._function_of(words)
        self._check(run(self.plan.address, *_vectors(words)))
        if self._tape is not None:
            made[self._tape] = made[self._tape][: words[_RESULTS + RESULTS.n_tape]]
        return tuple(made) if len(made) > 1 else made[0]

    def bound(self, *values: Any) -> "BoundCall":
        """A call that machine code makes as often as it wants, from one thread.

        It reads the arrays anew each time, also numbers that are passed by value, once they are
        copied to their places. What it checks about their shapes is checked now.
        """
        given = _arrays(values)
        words, results = self._prepared(given, is_checked=True)
        places = [place if is_value else None for place, _, is_value in self._places]
        return BoundCall(self.plan.address, words, results, places, given)

    def repeated(self, *values: Any) -> tuple[Callable[[], None], list[np.ndarray]]:
        """A call from Python that reads the same arrays anew each time, and its results.

        They are written anew by each call; numbers that are passed by value keep their values.
        """
        bound = self.bound(*values)
        run, check, plan = self._function_of(bound.words), self._check, bound.plan
        vectors = _vectors(bound.words)

        def call(_memory: BoundCall = bound) -> None:
            check(run(plan, *vectors))

        return call, bound.results

    def _function_of(self, words: array) -> Callable[..., int]:
        """The function to call with these words, of which some name another one."""
        replacement = words[_REPLACEMENT]
        return PlanFunction(replacement) if replacement else self.plan.run

    def _prepared(
        self, given: Sequence[np.ndarray], *, is_checked: bool = False
    ) -> tuple[array, list[np.ndarray]]:
        """The words of a call with these arguments, and its results, not written yet."""
        words = _DEFAULT_WORDS[:]
        for (place, shape, is_value), value in zip(self._places, given, strict=True):
            if is_value:
                words[place] = int(value)
                continue
            words[place] = address_of_array(value)
            for word, length in zip(shape, value.shape, strict=True):
                words[word] = length
        # A replacement is given only arguments that were checked.
        asks = is_checked or self._asks_for_sizes or words[_REPLACEMENT]
        if asks:
            words[_SIZES_ONLY] = 1
            self._check(self.plan.run(self.plan.address, *_vectors(words)))
            words[_SIZES_ONLY] = 0
        made = []
        for place, sizes in self._shapes:
            result = np.empty([self._size(words, s) if is_slot else s for s, is_slot in sizes])
            words[_RESULTS + place] = address_of_array(result)
            made.append(result)
        return words, made

    def _size(self, words: array, slot: int) -> int:
        return words[_RESULTS + slot if self._asks_for_sizes else _WORDS_OF_SIZES[slot]]

    def _check(self, status: int) -> None:
        if status:
            raise refusal(status)

    @cached_property
    def function(self) -> Any:
        """The same for compiled functions; numba compiles the call, not the plan."""
        return njit(error_model="numpy", nogil=True)(self.source())

    def source(self) -> Callable:
        """A function for numba to compile, without Python objects besides an intrinsic."""
        names = ", ".join(name for name, _ in self.arguments)
        namespace = {"__name__": __name__, "invoke": _invoke(self, self.plan.symbol)}
        text = f"def call({names}):\n    return invoke({names})\n"
        exec(compile(text, "<call of a plan>", "exec"), namespace)
        return namespace["call"]


def address_of_array(values: np.ndarray) -> int:
    """The address of an array; `ndarray.ctypes` takes four times as long."""
    try:
        return addressof(_NOTHING.from_buffer(values))
    except TypeError:  # it cannot be written to
        return values.ctypes.data


def _words_of(argument: Argument) -> tuple[int, list[int], bool]:
    """Where an argument goes among all words of a call, and where its shape goes."""
    first = _FIRST[argument.vector]
    return first + argument.slot, [first + slot for slot in argument.shape], argument.is_value


def _arrays(values: Sequence[Any]) -> list[np.ndarray]:
    """The arguments of a call as arrays; numbers become new ones."""
    return [value if type(value) is np.ndarray else np.asarray(value) for value in values]


def _shape(name: str, ndim: int) -> tuple[int, list[tuple[int, bool]]]:
    """The slot of a result's address, and its shape: slots of sizes, or numbers."""
    shape = SHAPES[name][len(SHAPES[name]) - ndim :]
    sizes = [(getattr(RESULTS, s), True) if isinstance(s, str) else (s, False) for s in shape]
    return getattr(RESULTS, name), sizes


def _invoke(planned: PlannedFunction, symbol: str) -> Any:
    """An intrinsic that makes the call."""
    arrays = [types.Array(types.float64, ndim, "C") for _, ndim in planned.results]
    returned = types.Tuple(arrays) if len(arrays) > 1 else arrays[0]

    def typed(typing_context: Any, kinds: tuple) -> tuple:
        def generate(context: Any, builder: Any, signature: Any, values: Sequence[Any]) -> Any:
            return _Emitter(context, builder, planned, symbol).call(signature.args, values)

        return returned(*kinds), generate

    names = ", ".join(f"{name}_{i}" for i, (name, _) in enumerate(planned.arguments))
    scope: dict[str, Any] = {"typed": typed}
    exec(f"def invoke(typing_context, {names}): return typed(typing_context, ({names},))", scope)
    return intrinsic(scope["invoke"])


class _Emitter:
    """Emits the call of a plan into a function that numba compiles."""

    def __init__(self, context: Any, builder: Any, planned: PlannedFunction, symbol: str) -> None:
        self._context, self._builder = context, builder
        self._planned, self._symbol = planned, symbol
        self._integer = context.get_value_type(types.intp)
        kind = ir.ArrayType(self._integer, _N_WORDS)
        with builder.goto_entry_block():
            self._memory = builder.alloca(kind)
        builder.store(ir.Constant(kind, list(_DEFAULT_WORDS)), self._memory)

    def call(self, kinds: Sequence[Any], values: Sequence[Any]) -> Any:
        """The results of the call with arguments of these types."""
        builder, given = self._builder, self._planned._given
        copies = []
        for kind, value, argument in zip(kinds, values, given, strict=True):
            if isinstance(kind, types.Array) and kind.layout != "C":
                value, kind = self._contiguous(kind, value)
                copies.append((kind, value))
            self._pass(argument, kind, value)
        plan = builder.ptrtoint(_global(builder, self._symbol), self._integer)
        function = self._load_at(plan, HEADER.run)
        self._set("request", REQUEST.sizes_only, self._integer(1))
        self._run(function, plan)
        results = [self._new(name, ndim) for name, ndim in self._planned.results]
        self._set("request", REQUEST.sizes_only, self._integer(0))
        replacement = self._get("request", REQUEST.replacement)
        is_replaced = builder.icmp_signed("!=", replacement, self._integer(0))
        self._run(builder.select(is_replaced, replacement, function), plan)
        for kind, value in copies:
            self._context.nrt.decref(builder, kind, value)
        made = [
            self._shortened(*result) if name == "tape" else result[1]._getvalue()
            for (name, _), result in zip(self._planned.results, results, strict=True)
        ]
        if len(made) == 1:
            return made[0]
        return self._context.make_tuple(builder, types.Tuple([kind for kind, _ in results]), made)

    def _contiguous(self, kind: Any, value: Any) -> tuple[Any, Any]:
        copied = types.Array(kind.dtype, kind.ndim, "C")
        copy = self._context.compile_internal(
            self._builder, lambda array: array.copy(), copied(kind), [value]
        )
        return copy, copied

    def _pass(self, argument: Argument, kind: Any, value: Any) -> None:
        builder = self._builder
        if isinstance(kind, types.Array):
            array = self._context.make_array(kind)(self._context, builder, value)
            if argument.is_value:
                number = builder.load(array.data)
                self._set(argument.vector, argument.slot, number)
                return
            address = builder.ptrtoint(array.data, self._integer)
            lengths = cgutils.unpack_tuple(builder, array.shape, kind.ndim)
            for slot, length in zip(argument.shape, lengths, strict=True):
                self._set(argument.vector, slot, length)
        elif argument.is_value:
            address = self._context.cast(builder, value, kind, types.intp)
        else:
            number = self._context.cast(builder, value, kind, types.float64)
            place = cgutils.alloca_once_value(builder, number)
            address = builder.ptrtoint(place, self._integer)
        self._set(argument.vector, argument.slot, address)

    def _word(self, vector: str, slot: int) -> Any:
        return cgutils.gep_inbounds(self._builder, self._memory, 0, _FIRST[vector] + slot)

    def _set(self, vector: str, slot: int, value: Any) -> None:
        self._builder.store(value, self._word(vector, slot))

    def _get(self, vector: str, slot: int) -> Any:
        return self._builder.load(self._word(vector, slot))

    def _load_at(self, address: Any, slot: int) -> Any:
        words = self._builder.inttoptr(address, self._integer.as_pointer())
        return self._builder.load(cgutils.gep_inbounds(self._builder, words, slot))

    def _run(self, function: Any, plan: Any) -> None:
        """Call, and raise what a status says."""
        builder = self._builder
        kind = ir.FunctionType(self._integer, [self._integer] * 4)
        vectors = [builder.ptrtoint(self._word(vector, 0), self._integer) for vector in _FIRST]
        status = builder.call(builder.inttoptr(function, kind.as_pointer()), [plan, *vectors])
        is_refused = builder.icmp_signed("!=", status, self._integer(0))
        with builder.if_then(is_refused, likely=False):
            for each in Refusal:
                with builder.if_then(builder.icmp_signed("==", status, self._integer(each))):
                    self._context.call_conv.return_user_exc(
                        builder, _exception(each), (each.message,)
                    )

    def _new(self, name: str, ndim: int) -> tuple[Any, Any]:
        kind = types.Array(types.float64, ndim, "C")
        slot, shape = _shape(name, ndim)
        sizes = [
            self._get("results", size) if is_slot else self._integer(size)
            for size, is_slot in shape
        ]
        array = _empty_nd_impl(self._context, self._builder, kind, sizes)
        self._set("results", slot, self._builder.ptrtoint(array.data, self._integer))
        return kind, array

    def _shortened(self, kind: Any, array: Any) -> Any:
        """A tape of the length that was written."""
        builder = self._builder
        _, width = cgutils.unpack_tuple(builder, array.shape, 2)
        shape = [self._get("results", RESULTS.n_tape), width]
        populate_array(array, array.data, shape, array.strides, array.itemsize, array.meminfo)
        return array._getvalue()


def _global(builder: Any, name: str) -> Any:
    module = builder.module
    if name in module.globals:
        return module.globals[name]
    return ir.GlobalVariable(module, ir.IntType(8), name)
