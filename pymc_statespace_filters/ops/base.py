"""The base class of all operations on a record: inputs, and machine code.

Operations are pure: parameters, data and the noise seed are inputs, and equal inputs give equal
outputs. No data are closed over, so neither PyTensor's merging of equal nodes nor the cache of
machine code on disk can confuse two data sets.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, ClassVar, Self

import numpy as np
import pytensor.tensor as pt
from pytensor.gradient import grad_not_implemented
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.op import Op
from pytensor.link.numba.dispatch.basic import numba_njit, register_funcify_and_cache_key

from ..compiler.lowering.compiled_system import CompiledSystem, compile_system
from ..compiler.native.compilation import COMPILATION, without_traces
from ..compiler.native.plan import ARGUMENTS, Plan
from ..compiler.native.planned_function import PlannedFunction
from ..compiler.native.python_call import TimedCall, call_machine_code
from ..filters.protocol import Filter
from ..system.model import StateSpaceModel
from ..system.panel_records import STEP
from .signatures import ONE_RECORD, Form, Signature

HEALTH_SIZE = 3
_READY = 0x0001 | 0x0100 | 0x0400  # flags of NumPy: contiguous in C's order, aligned, writeable
_INTEGERS = {name for (name, _), argument in ARGUMENTS.items() if argument.is_value}
_INTEGERS |= {"steps", "wanted"}
_CORE_SHAPES = {
    ("theta", 1): "k", ("theta", 2): "g,k", ("steps", 1): "j", ("steps", 2): "j,c",
    ("observed", 2): "j,p", ("inputs", 2): "s,u", ("normals", 1): "z", ("terms_bar", 1): "j",
    ("terms", 1): "j", ("health", 1): "h", ("theta_bar", 1): "k", ("theta_bar", 2): "g,k",
}  # fmt: skip


class FilterOp(Op):
    """An operation on parameters and one or several records, made of a system and a filter.

    The names of its inputs and outputs are those of `compiler.native.plan`.
    """

    __props__ = ("system", "filter", "form")
    signature: ClassVar[Signature]
    # Whether its machine code exchanges numbers with other ranks, from the thread that calls it.
    is_collective: ClassVar[bool] = False

    def __init__(self, system: StateSpaceModel, filter: Filter, form: Form = ONE_RECORD) -> None:
        self.system = system
        self.filter = filter
        self.form = form
        self.arguments = form.of(self.signature.arguments)
        self.results = form.of(self.signature.results)

    def __str__(self) -> str:
        # The default would print every equation of the system.
        form = "" if self.form == ONE_RECORD else f", {self.form.name}"
        return f"{type(self).__name__}{{{self.filter}{form}}}"

    def of(self, system: StateSpaceModel, filter: Filter) -> Self:
        """The same operation of another system or filter."""
        return type(self)(system, filter, self.form)

    def plan(self, system: CompiledSystem) -> Plan:
        """Plan the function of the inputs."""
        raise NotImplementedError

    def symbol(self, name: str) -> Variable:
        """A symbol for an argument."""
        return pt.tensor(name, dtype=_dtype(name), shape=(None,) * dict(self.arguments)[name])

    @staticmethod
    def array(name: str, value: Any) -> np.ndarray:
        """The value of an argument, in order and of its type."""
        return _ready(value, np.dtype(_dtype(name)))

    @property
    def gufunc_signature(self) -> str:
        """Core shapes, for `Blockwise`."""
        given, made = (
            ",".join(f"({_CORE_SHAPES.get(each, '')})" for each in names)
            for names in (self.arguments, self.results)
        )
        return f"{given}->{made}"

    def n_steps(self, inputs: Sequence[np.ndarray]) -> int:
        """Steps of an evaluation, roughly; the steps of a panel are a column of its rows."""
        if self.arguments[0][0] != "theta":  # nothing is filtered, as where normals are drawn
            return 0
        theta, steps = inputs[:2]
        if not steps.size:
            return 0
        last = steps[-1] if steps.ndim == 1 else steps[-1, STEP]
        return int(last) * (len(theta) if theta.ndim == 2 else 1)

    def make_node(self, *inputs: Any) -> Apply:
        """Apply to symbols or numbers; the names and dimensions are in `arguments`."""
        typed = [_typed(*each) for each in zip(inputs, self.arguments, strict=True)]
        outputs = [pt.tensor(dtype="float64", shape=(None,) * ndim) for _, ndim in self.results]
        return Apply(self, typed, outputs)

    def perform(self, node: Apply, inputs: Sequence, output_storage: Sequence) -> None:
        """Evaluate in PyTensor's modes without numba: by the same machine code."""
        values = evaluator(self)(*inputs)
        for cell, value in zip(output_storage, values, strict=True):
            cell[0] = value


def _dtype(name: str) -> str:
    return "int64" if name in _INTEGERS else "float64"


def _typed(value: Any, argument: tuple[str, int]) -> Variable:
    name, ndim = argument
    if not isinstance(value, Variable):
        return pt.as_tensor(value, dtype=_dtype(name), ndim=ndim)
    if value.type.ndim != ndim:
        raise TypeError(f"{name} must have {ndim} dimensions, got {value.type}")
    return value if value.type.dtype == _dtype(name) else pt.cast(value, _dtype(name))


@cache
def evaluator(op: FilterOp) -> Any:
    """A Python function of the operation's inputs, arrays or numbers.

    It goes without PyTensor's function, which would take as long to compile again, and whose object
    stores the arguments of a call in cells that all threads would overwrite.
    """
    with COMPILATION:
        function = kernel(op).loaded()
    kinds = [np.dtype(_dtype(name)) for name, _ in op.arguments]
    call = TimedCall(function)

    def evaluate(*values: Any) -> tuple:
        arrays = [_ready(v, kind) for v, kind in zip(values, kinds, strict=True)]
        if op.is_collective:
            results = call_machine_code(function, *arrays)
        else:
            results = call(arrays, op.n_steps(arrays))
        return results if isinstance(results, tuple) else (results,)

    return evaluate


def _ready(value: Any, kind: np.dtype) -> np.ndarray:
    """An array of this type, in order and writeable: another one would be compiled for again."""
    if type(value) is np.ndarray and value.dtype is kind and value.flags.num & _READY == _READY:
        return value
    return np.require(value, kind, ("C", "A", "W"))


@cache
@without_traces()
def kernel(op: FilterOp) -> PlannedFunction:
    """The compiled function of an operation, made once."""
    plan = op.plan(compile_system(op.system))
    return PlannedFunction(plan, op.arguments, op.results)


def theta_cotangent_only(op: Op, inputs: Sequence[Variable], theta_bar: Variable) -> list[Variable]:
    """Cotangents of all inputs, of which theta's is known and the record has none."""
    data_bars = [
        grad_not_implemented(op, i, variable, "only parameters have a gradient")
        for i, variable in enumerate(inputs[1:], start=1)
    ]
    return [theta_bar, *data_bars]


@register_funcify_and_cache_key(FilterOp)
def _numba(op: FilterOp, node: Apply | None = None, **kwargs: Any) -> tuple:
    """The compiled function of an operation, and its key."""
    compiled = kernel(op)
    return numba_njit(compiled.source()), compiled.key
