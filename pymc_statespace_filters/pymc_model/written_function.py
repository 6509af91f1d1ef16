"""Compiled PyTensor functions of few numbers, written out in scalars around calls of filters.

The log-density of most models is some dozens of scalar operations and the likelihoods of filters.
Numba needs a second to compile such a graph; written out as scalar code it takes hundredths, and
nothing of a filter is compiled again. What is too large, or has no scalar form, is left to numba.
"""

import ctypes
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import pytensor.scalar as ps
from pytensor.compile.builders import OpFromGraph
from pytensor.graph.basic import Apply, Constant, Variable
from pytensor.graph.fg import FunctionGraph
from pytensor.graph.op import Op
from pytensor.graph.traversal import io_toposort
from pytensor.raise_op import CheckAndRaise
from pytensor.tensor.basic import ScalarFromTensor, TensorFromScalar
from pytensor.tensor.elemwise import CAReduce, Elemwise

from ..compiler.codegen.emitter import n_operations
from ..compiler.codegen.expressions import Arena, Value, is_constant
from ..compiler.codegen.functions import log_choice, vector_code
from ..compiler.codegen.machine_code import ModuleEntryPoint
from ..compiler.codegen.scalarize import NotUnrollableError, evaluate, objects
from ..compiler.native.compilation import COMPILATION
from ..compiler.native.composed_call import WORD, Copy, ScalarCall, Sum, status_of, table_of
from ..compiler.native.entry_point import F64_PTR
from ..compiler.native.plan import N_RECORD, N_REQUEST, REQUEST, RESULTS
from ..compiler.native.planned_function import BoundCall, PlannedFunction, refusal
from ..compiler.native.pytensor_function import Call, NativeFunction
from ..ops.base import HEALTH_SIZE, FilterOp, kernel

MAX_OPERATIONS = 1000  # an operation takes about a millisecond to compile
_MAX_ELEMENTS = 2000  # of an array
# Results of filters that are known here, and the place of one of them.
_RESULTS, _TAPE = {"terms", "health", "tape", "theta_bar"}, 2
# Words of a call: the length of the tape that it leaves, and of the one that it is given.
_LENGTH_LEFT = N_RECORD + N_REQUEST + RESULTS.n_tape
_LENGTH_GIVEN = N_RECORD + REQUEST.n_tape
_SCALAR_CODE = {"given": F64_PTR, "out": F64_PTR}


def native_function(
    function: Any,
    example: Sequence[np.ndarray],
    errors: Callable[[], AbstractContextManager] = nullcontext,
) -> NativeFunction:
    """A compiled PyTensor function as machine code, written out where it is small enough."""
    has_updates = len(function.maker.fgraph.outputs) > len(function.maker.outputs)
    if not has_updates and hasattr(function.vm, "jit_fn"):
        try:
            return WrittenFunction(function, example, errors)
        except NotUnrollableError as reason:
            log_choice("density", reason)
    return NativeFunction(function, example, errors)


class _Terms(NamedTuple):
    """Terms of the log-likelihood by a filter, of which a graph takes nothing but the sum.

    ``runs`` are the rows that count, from one to before another; None for all.
    """

    call: int
    runs: tuple[tuple[int, int], ...] | None = None


class _Tape(NamedTuple):
    """What a forward pass has left for the backward pass of the same filter."""

    call: int


class _Run(NamedTuple):
    """Rows whose terms are added up; to the last one if there is no ``end``."""

    call: int
    begin: int = 0
    end: int | None = None


class _Number(NamedTuple):
    """A number that the scalar code reads.

    An element of the input, or of the health or the gradient by the call, of this number, or the
    sum of this number.
    """

    kind: str
    number: int
    element: int = 0


class _Source(NamedTuple):
    """Where an argument of a filter comes from: an input, a constant, or numbers made before."""

    input: int | None = None
    constant: np.ndarray | None = None
    computed: np.ndarray | None = None  # of expressions
    tape_of: int | None = None  # a call


@dataclass
class _Parts:
    """A graph in parts: arguments of filters, sums of their terms, and what is made of these.

    ``numbers`` are the inputs of the expressions, by their names.
    """

    inputs: list[Variable]
    arrays: list[np.ndarray]
    arena: Arena = field(default_factory=Arena)
    known: dict[Variable, Any] = field(default_factory=dict)
    numbers: dict[str, _Number] = field(default_factory=dict)
    filters: list[tuple[PlannedFunction, list[_Source]]] = field(default_factory=list)
    sums: list[_Run] = field(default_factory=list)
    holds: Value = True  # whether all checks of the graph do

    def __post_init__(self) -> None:
        self._places = {variable: i for i, variable in enumerate(self.inputs)}

    def run(self, inputs: Sequence[Variable], outputs: Sequence[Variable]) -> list[Any]:
        """Write out a graph whose inputs are known."""
        for node in io_toposort(inputs, outputs):
            results = self._results(node)
            self.known.update(zip(node.outputs, results, strict=True))
            if len(self.arena) > 20 * MAX_OPERATIONS:
                raise NotUnrollableError("too many scalar operations")
        return [self._value(variable) for variable in outputs]

    def _value(self, variable: Variable) -> Any:
        if variable in self.known:
            return self.known[variable]
        if isinstance(variable, Constant):
            data = variable.data
            if isinstance(data, np.ndarray) and data.size > _MAX_ELEMENTS:
                raise NotUnrollableError(f"more than {_MAX_ELEMENTS} numbers")
            self.known[variable] = objects(data)
        elif variable in self._places:
            self.known[variable] = self._elements(self._places[variable])
        else:
            raise NotUnrollableError(f"an input that is not an argument, {variable}")
        return self.known[variable]

    def _elements(self, i: int) -> np.ndarray:
        array = self.arrays[i]
        if array.dtype != np.float64 or array.size > _MAX_ELEMENTS:
            raise NotUnrollableError("an input that is no short vector of numbers")
        return self._array_of("input", i, array.shape)

    def _array_of(self, kind: str, number: int, shape: tuple[int, ...]) -> np.ndarray:
        found = np.empty(int(np.prod(shape)), dtype=object)
        found[:] = [self._read(_Number(kind, number, k)) for k in range(found.size)]
        return found.reshape(shape)

    def _read(self, number: _Number) -> Value:
        name = ".".join(map(str, number))
        self.numbers[name] = number
        return self.arena.input(name)

    def _results(self, node: Apply) -> list[Any]:
        if isinstance(node.op, FilterOp):
            return self._of_filter(node)
        if isinstance(node.op, OpFromGraph):
            inner = node.op.fgraph
            values = [self._value(variable) for variable in node.inputs]
            self.known.update(zip(inner.inputs, values, strict=True))
            for each in inner.toposort():  # again, if the operation is applied twice
                for output in each.outputs:
                    self.known.pop(output, None)
            return self.run(inner.inputs, inner.outputs)
        arguments = [self._value(variable) for variable in node.inputs]
        if any(isinstance(argument, _Tape) for argument in arguments):
            raise NotUnrollableError(f"a tape in the operation {node.op}")
        if any(isinstance(argument, _Terms) for argument in arguments):
            return [self._of_terms(node.op, arguments)]
        if isinstance(node.op, CheckAndRaise):
            value, *conditions = arguments
            for condition in np.concatenate([c.ravel() for c in conditions]):
                self.holds = self.arena.apply(ps.and_, self.holds, condition)
            return [value]
        if _adds_truth_values(node):
            raise NotUnrollableError("a sum of truth values")
        return [objects(result) for result in evaluate(self.arena, node, arguments)]

    def _of_terms(self, op: Op, arguments: list[Any]) -> Any:
        terms, *_ = arguments
        if isinstance(op, CAReduce) and isinstance(op.scalar_op, ps.Add):
            runs = [(0, None)] if terms.runs is None else terms.runs
            sums = [self._sum(_Run(terms.call, *run)) for run in runs]
            return objects(self.arena.apply(ps.add, 0.0, *sums))
        if isinstance(op, ScalarFromTensor | TensorFromScalar):
            return terms
        if isinstance(op, Elemwise) and isinstance(op.scalar_op, ps.Switch):
            mask, terms, zeros = arguments  # those that are not scored are left out
            is_known = isinstance(mask, np.ndarray) and all(map(is_constant, mask))
            if is_known and isinstance(terms, _Terms) and terms.runs is None and _are_zero(zeros):
                return terms._replace(runs=_runs(mask))
        raise NotUnrollableError(f"terms in the operation {op}")

    def _sum(self, run: _Run) -> Value:
        if run not in self.sums:
            self.sums.append(run)
        return self._read(_Number("sum", self.sums.index(run)))

    def _of_filter(self, node: Apply) -> list[Any]:
        with COMPILATION:
            planned = kernel(node.op)
        names = [name for name, _ in node.op.results]
        if not isinstance(planned, PlannedFunction) or not set(names) <= _RESULTS:
            raise NotUnrollableError(f"the operation {node.op}")
        if names[0] == "terms" and node.outputs[0].type.ndim != 1:
            raise NotUnrollableError("terms of many points")
        number = len(self.filters)
        self.filters.append((planned, [self._source(variable) for variable in node.inputs]))
        results = {
            "terms": lambda: _Terms(number),
            "health": lambda: self._array_of("health", number, (HEALTH_SIZE,)),
            "tape": lambda: _Tape(number),
            "theta_bar": lambda: self._array_of("gradient", number, self._shape(node.inputs[0])),
        }
        return [results[name]() for name in names]

    def _shape(self, parameters: Variable) -> tuple[int, ...]:
        """The shape of the parameters of a filter, which is that of their gradient."""
        if parameters in self._places:
            return self.arrays[self._places[parameters]].shape
        return np.shape(self._value(parameters))

    def _source(self, variable: Variable) -> _Source:
        if variable in self._places:
            return _Source(input=self._places[variable])
        if isinstance(variable, Constant):
            return _Source(constant=np.require(variable.data, requirements=("C", "A", "W")))
        values = self._value(variable)
        if isinstance(values, _Tape):
            return _Source(tape_of=values.call)
        if isinstance(values, _Terms) or variable.type.dtype != "float64":
            raise NotUnrollableError("an argument of a filter that is not made of parameters")
        return _Source(computed=values)


def _adds_truth_values(node: Apply) -> bool:
    """Whether an operation adds truth values: a number for numba, a truth value for NumPy."""
    op = node.op.scalar_op if isinstance(node.op, Elemwise) else node.op
    nodes = op.fgraph.toposort() if isinstance(op, ps.Composite) else [node]
    sums = [each for each in nodes if isinstance(op if each is node else each.op, ps.Add)]
    return any(each.outputs[0].type.dtype == "bool" for each in sums)


def _are_zero(values: Any) -> bool:
    return isinstance(values, np.ndarray) and all(is_constant(v) and v == 0 for v in values.flat)


def _runs(mask: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Where runs of truth begin and end."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask.astype(bool), [False]])))
    return tuple((int(begin), int(end)) for begin, end in edges.reshape(-1, 2))


class _Written(NamedTuple):
    """Scalar code, and the names of the numbers that it reads."""

    code: ModuleEntryPoint
    used: list[str]

    @classmethod
    def of(cls, name: str, values: Sequence[Value]) -> "_Written":
        """Write out expressions."""
        if n_operations(values) > MAX_OPERATIONS:
            raise NotUnrollableError(f"more than {MAX_OPERATIONS} scalar operations")
        code, used = vector_code(values)
        return cls(ModuleEntryPoint(code, _SCALAR_CODE, name), used)


class WrittenFunction(NativeFunction):
    """A compiled PyTensor function as scalar code around calls of filters: a `NativeFunction`.

    Raises `NotUnrollableError` if it has no such form, or is too large.
    """

    def __init__(
        self,
        function: Any,
        example: Sequence[np.ndarray],
        errors: Callable[[], AbstractContextManager] = nullcontext,
    ) -> None:
        self._function, self._errors, self.is_native = function, errors, True
        self.example = [np.require(value, requirements=("C", "W")) for value in example]
        graph: FunctionGraph = function.maker.fgraph
        shared = [cell.storage[0] for cell in function.input_storage[len(example) :]]
        if not all(isinstance(value, np.ndarray) for value in shared):
            raise NotUnrollableError("an input that is no array")
        self._data = [np.array(value, order="C") for value in shared]
        self._parts = parts = _Parts(graph.inputs, [*self.example, *self._data])
        results = parts.run(graph.inputs, graph.outputs)
        if any(isinstance(result, _Terms | _Tape) for result in results):
            raise NotUnrollableError("terms or a tape as a result")
        self.kinds = [
            (result.shape, np.dtype(output.type.dtype))
            for result, output in zip(results, graph.outputs, strict=True)
        ]
        failed = parts.arena.apply(ps.switch, parts.holds, 0.0, 1.0)
        given = [s.computed for _, sources in parts.filters for s in sources]
        computed = [value for array in given if array is not None for value in array.flat]
        self._before = _Written.of("arguments", computed)
        self._after = _Written.of("density", [failed, *(v for r in results for v in r.flat)])
        if any(parts.numbers[name].kind != "input" for name in self._before.used):
            raise NotUnrollableError("a filter whose arguments depend on the result of another one")
        self._n_computed = len(computed)
        self._lock = Lock()
        self._own: tuple[list[np.ndarray], Call, Any] | None = None
        log_choice("density")

    def __call__(self, *inputs: np.ndarray) -> list[np.ndarray]:
        """Call from Python."""
        with self._errors(), self._lock:
            if self._own is None:
                arrays = [np.array(value, order="C") for value in self.example]
                self._own = arrays, *self.bind(arrays)
            arrays, call, _ = self._own
            for array, value in zip(arrays, inputs, strict=True):
                array[...] = value
            run = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(int(call.table[0]))
            run(call.table.ctypes.data, call.out.ctypes.data)
            if call.out[0]:
                self._raise(call, inputs)
        values = np.split(call.out[1:].copy(), np.cumsum([int(np.prod(s)) for s, _ in self.kinds]))
        return [
            value.reshape(shape).astype(dtype)
            for value, (shape, dtype) in zip(values, self.kinds, strict=False)
        ]

    def _raise(self, call: Call, inputs: Sequence[np.ndarray]) -> None:
        """Raise what the graph would: the refusal of a filter, or a check that failed."""
        if status := status_of(call.table):
            raise refusal(status)
        self._function(*inputs)

    def bind(self, inputs: Sequence[np.ndarray]) -> tuple[Call, Callable[[], object]]:
        """A call that reads these contiguous arrays, and a function that repeats it from Python.

        The function raises the exception of the call, and holds its memory: keep it as long.
        """
        arrays = [*inputs, *self._data]
        computed = np.zeros(self._n_computed)
        calls = self._bound(arrays, computed)
        given = [np.zeros(len(written.used)) for written in (self._before, self._after)]
        places = _Places(arrays, calls, self._parts.sums, self._parts.numbers)
        lengths = {i: np.array([call.words[_LENGTH_LEFT]]) for i, call in enumerate(calls)}
        copies_before = [
            *places.seeds(self._parts.filters),
            *places.tape_lengths(self._parts.filters, lengths),
            *places.copies(self._before.used, given[0]),
        ]
        copies_after = places.copies(self._after.used, given[1])
        sums = places.sums_into(self._after.used, given[1])
        for written in (self._before, self._after):
            written.code.compile()
        table = table_of(
            ScalarCall(self._before.code.address, given[0].ctypes.data, computed.ctypes.data),
            ScalarCall(self._after.code.address, given[1].ctypes.data),
            calls, sums, copies_before, copies_after, places.tapes(self._parts.filters),
        )  # fmt: skip
        call, memory = (
            Call(table, np.zeros(1 + self.size)),
            (arrays, computed, calls, given, lengths),
        )
        return call, lambda _memory=memory: self(*inputs)

    def _bound(self, arrays: Sequence[np.ndarray], computed: np.ndarray) -> list[BoundCall]:
        """The calls of the filters, with what is computed for them in parts of one vector."""
        calls: list[BoundCall] = []
        first = 0
        for planned, sources in self._parts.filters:
            arguments: list[Any] = []
            for source in sources:
                given: Any
                if source.tape_of is not None:
                    given = calls[source.tape_of].results[_TAPE]
                elif source.computed is None:
                    given = source.constant if source.input is None else arrays[source.input]
                else:
                    part = computed[first : first + source.computed.size]
                    given, first = part.reshape(source.computed.shape), first + part.size
                arguments.append(given)
            calls.append(planned.bound(*arguments))
        return calls


class _Places(NamedTuple):
    """Addresses of the numbers that the scalar code reads, by their names."""

    arrays: Sequence[np.ndarray]
    calls: Sequence[BoundCall]
    sums: Sequence[_Run]
    numbers: Mapping[str, _Number]

    def seeds(self, filters: Sequence[tuple[PlannedFunction, list[_Source]]]) -> list[Copy]:
        """Copies of inputs that filters are given by value."""
        return [
            Copy(self.arrays[source.input].ctypes.data, call.words.buffer_info()[0] + WORD * place)
            for call, (_, sources) in zip(self.calls, filters, strict=True)
            for source, place in zip(sources, call.places, strict=True)
            if place is not None and source.input is not None
        ]

    def tape_lengths(
        self, filters: Sequence[tuple[PlannedFunction, list[_Source]]], lengths: Mapping
    ) -> list[Copy]:
        """Copies of the lengths of tapes to where a filter overwrites them by what it has used."""
        taped = {s.tape_of for _, sources in filters for s in sources if s.tape_of is not None}
        return [Copy(lengths[i].ctypes.data, self._word(i, _LENGTH_LEFT)) for i in sorted(taped)]

    def tapes(self, filters: Sequence[tuple[PlannedFunction, list[_Source]]]) -> dict[int, Copy]:
        """Before a backward pass, the copy of the length of the tape that was left for it."""
        return {
            i: Copy(self._word(source.tape_of, _LENGTH_LEFT), self._word(i, _LENGTH_GIVEN))
            for i, (_, sources) in enumerate(filters)
            for source in sources
            if source.tape_of is not None
        }

    def _word(self, call: int, word: int) -> int:
        return int(self.calls[call].words.buffer_info()[0]) + WORD * word

    def copies(self, names: Sequence[str], given: np.ndarray) -> list[Copy]:
        """Copies of single numbers to their places in front of the scalar code."""
        found = []
        for i, (kind, number, element) in enumerate(map(self.numbers.__getitem__, names)):
            if kind != "sum":
                source = self._array(kind, number).ctypes.data + WORD * element
                found.append(Copy(source, given.ctypes.data + WORD * i))
        return found

    def _array(self, kind: str, number: int) -> np.ndarray:
        if kind == "input":
            return self.arrays[number]
        return self.calls[number].results[1 if kind == "health" else 0].reshape(-1)

    def sums_into(self, names: Sequence[str], given: np.ndarray) -> list[Sum]:
        """The sums of terms, to their places in front of the scalar code."""
        found = []
        for i, (kind, number, _) in enumerate(map(self.numbers.__getitem__, names)):
            if kind == "sum":
                call, begin, end = self.sums[number]
                terms = self.calls[call].results[0][begin:end]
                found.append(Sum(terms.ctypes.data, terms.size, given.ctypes.data + WORD * i))
        return found
