"""The base class of all operations on a record: inputs, their checks, and machine code.

Operations are pure: parameters, data and the noise seed are inputs, and equal inputs give equal
outputs. No data are closed over, so neither PyTensor's merging of equal nodes nor the cache of
machine code on disk can confuse two data sets.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, ClassVar

import numpy as np
import pytensor.tensor as pt
from numba import typeof
from pytensor.gradient import grad_not_implemented
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.op import Op
from pytensor.link.numba.dispatch.basic import numba_njit, register_funcify_and_cache_key
from pytensor.tensor.type import TensorType

from ..compiler.codegen.function_types import CompiledFunction, jit
from ..compiler.lowering.compiled_system import CompiledSystem, compile_system
from ..compiler.native.cache_key import key_of
from ..compiler.native.compilation import COMPILATION
from ..compiler.native.entry_point import cached_on_disk
from ..compiler.native.planned_function import PlannedFunction
from ..compiler.native.python_call import TimedCall, call_machine_code
from ..errors import ModelError
from ..filters.protocol import Compiled, Filter
from ..parallel.signals import held_interrupts
from ..progress import slow_compilation
from ..system.model import StateSpaceModel
from ..system.panel import FIRST_INPUT, N_COLUMNS, RECORD, STEP

HEALTH_SIZE = 3
_READY = 0x0001 | 0x0100 | 0x0400  # flags of NumPy: contiguous in C's order, aligned, writeable

RECORD_INPUTS = (
    ("theta", "float64", 1),
    ("steps", "int64", 1),
    ("observed", "float64", 2),
    ("inputs", "float64", 2),
    ("t0", "float64", 0),
    ("seed", "int64", 0),
)


class FilterOp(Op):
    """An operation on parameters and a record, made of a system and a filter."""

    __props__ = ("system", "filter")
    input_types: ClassVar[tuple[tuple[str, str, int], ...]] = RECORD_INPUTS
    output_types: ClassVar[tuple[TensorType, ...]]
    # The names of the outputs as results of a plan.
    result_names: ClassVar[tuple[str, ...]] = ("terms", "health")
    # Calls of the checks of what `pm.set_data` may have replaced; kernels do not check bounds.
    record_checks: ClassVar[tuple[str, ...]] = (
        "check(steps, inputs)",
        "check_observed(steps, observed)",
    )
    # How an input is written in the call of a kernel without a plan, where not as a number or a
    # copy; None if it is left out.
    argument_code: ClassVar[Mapping[str, str | None]] = {}
    # Whether its machine code exchanges numbers with other ranks, from the thread that calls it.
    is_collective: ClassVar[bool] = False

    def __init__(self, system: StateSpaceModel, filter: Filter) -> None:
        self.system = system
        self.filter = filter

    def __str__(self) -> str:
        # The default would print every equation of the system.
        return f"{type(self).__name__}{{{self.filter}}}"

    def compile(self, system: CompiledSystem) -> Compiled:
        """Compile the function of the inputs."""
        raise NotImplementedError

    @property
    def results(self) -> list[tuple[str, int]]:
        """Names and dimensions of the outputs."""
        kinds = zip(self.result_names, self.output_types, strict=True)
        return [(name, kind.ndim) for name, kind in kinds]

    def n_steps(self, inputs: Sequence[np.ndarray]) -> int:
        """Steps of an evaluation, roughly; the steps of a panel are a column of its rows."""
        if self.input_types[0][0] != "theta":  # nothing is filtered, as where normals are drawn
            return 0
        theta, steps = inputs[:2]
        if not steps.size:
            return 0
        last = steps[-1] if steps.ndim == 1 else steps[-1, STEP]
        return int(last) * (len(theta) if theta.ndim == 2 else 1)

    def make_node(self, *inputs: Any) -> Apply:
        """Apply to symbols or numbers; the names and types are in `input_types`."""
        return Apply(self, _typed(inputs, self.input_types), [kind() for kind in self.output_types])

    def perform(self, node: Apply, inputs: Sequence, output_storage: Sequence) -> None:
        """Evaluate in PyTensor's modes without numba: by the same machine code."""
        values = evaluator(self)(*inputs)
        for cell, value in zip(output_storage, values, strict=True):
            cell[0] = value


def _typed(inputs: Sequence[Any], types: Sequence[tuple[str, str, int]]) -> list[Variable]:
    return [
        pt.as_tensor(value, dtype=dtype, ndim=ndim)
        if not isinstance(value, Variable)
        else _checked(value, name, dtype, ndim)
        for value, (name, dtype, ndim) in zip(inputs, types, strict=True)
    ]


def _checked(value: Variable, name: str, dtype: str, ndim: int) -> Variable:
    if value.type.ndim != ndim:
        raise TypeError(f"{name} must have {ndim} dimensions, got {value.type}")
    return value if value.type.dtype == dtype else pt.cast(value, dtype)


@cache
def evaluator(op: FilterOp) -> Any:
    """A Python function of the operation's inputs, arrays or numbers.

    It goes without PyTensor's function, which would take as long to compile again, and whose object
    stores the arguments of a call in cells that all threads would overwrite.
    """
    with COMPILATION:
        compiled = kernel(op)
        if isinstance(compiled, PlannedFunction):
            function: Callable = compiled.loaded()
        else:
            function = _jitted(op, compiled)
    kinds = [np.dtype(dtype) for _, dtype, _ in op.input_types]
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


def _jitted(op: FilterOp, kernel: CompiledFunction) -> Callable:
    """A compiled function of an operation whose filter has no plan; on disk if it has a key."""
    function, key = _call(op, kernel)
    machine_code = cached_on_disk(jit(function), key)

    def call(*arrays: np.ndarray) -> Any:
        if not machine_code.overloads:
            with held_interrupts(), slow_compilation(f"{type(op.filter).__name__} for this system"):
                machine_code.compile(tuple(map(typeof, arrays)))
        return machine_code(*arrays)

    return call


def check_record(system: StateSpaceModel) -> Any:
    """A compiled check of steps and inputs."""
    return _check_of_inputs(system.n_input_columns, int(system.observation_uses_inputs))


# Made once for all systems of one shape: a fresh one would be compiled by the next call.
@cache
def _check_of_inputs(n_columns: int, last_row: int) -> Any:
    @jit
    def check(steps, inputs):
        for j in range(steps.size):
            if steps[j] < 0 or (j > 0 and steps[j] <= steps[j - 1]):
                raise ModelError("steps must not be negative and must increase strictly")
        if n_columns and inputs.shape[1] != n_columns:
            raise ModelError("inputs must have one column for each input of the system")
        if n_columns and steps.size and inputs.shape[0] < steps[-1] + last_row:
            raise ModelError("inputs has too few rows: row k holds during step k")

    return check


def check_panel(system: StateSpaceModel) -> Any:
    """A compiled check of the rows of a panel, see `system.panel`."""
    return _check_of_rows(system.n_input_columns, int(system.observation_uses_inputs))


@cache
def _check_of_rows(n_columns: int, last_row: int) -> Any:
    @jit
    def check(theta, rows, inputs):
        if rows.shape[1] != N_COLUMNS:
            raise ModelError("the rows of a panel must have a column each for record, step, inputs")
        if n_columns and inputs.shape[1] != n_columns:
            raise ModelError("inputs must have one column for each input of the system")
        n_records = 0
        for j in range(rows.shape[0]):
            begins = j == 0 or rows[j, RECORD] != rows[j - 1, RECORD]
            n_records += begins
            if rows[j, STEP] < 0 or (not begins and rows[j, STEP] <= rows[j - 1, STEP]):
                raise ModelError(
                    "steps must not be negative and must increase strictly within a record"
                )
            if n_columns and inputs.shape[0] < rows[j, FIRST_INPUT] + rows[j, STEP] + last_row:
                raise ModelError("inputs has too few rows: row k holds during step k")
        if n_records != theta.shape[0]:
            raise ModelError(
                "the parameters must have a row for each record of the panel; for another number "
                "of records replace the parameters' dimension too"
            )

    return check


@cache
def check_observed(p: int) -> Any:
    """A compiled check that a record has the shape that the kernels read."""

    @jit
    def check(steps, observed):
        if observed.shape[0] != steps.shape[0] or observed.shape[1] != p:
            raise ModelError(
                "observed must have a row for each step and a column for each observable; for a "
                "record of another length give the variable steps and observed as pm.Data with "
                "dims=(..., ...), as StateSpace says, and replace both in one pm.set_data"
            )

    return check


def cache_key(system: StateSpaceModel, compiled: Compiled) -> str | None:
    """The key of a compiled function together with the checks of its record."""
    checked = (system.p, system.n_input_columns, system.observation_uses_inputs)
    return key_of(__name__, f"checked for {checked}", compiled.key)


@cache
def kernel(op: FilterOp) -> Compiled:
    """The compiled function of an operation, made once."""
    compiled = op.compile(compile_system(op.system))
    if isinstance(compiled, PlannedFunction):
        arguments = [(name, ndim) for name, _, ndim in op.input_types]
        return PlannedFunction(compiled.plan, arguments, op.results)
    return compiled


class ThetaDerivative(FilterOp):
    """An operation whose result is a cotangent of theta."""

    output_types = (pt.dvector,)
    result_names = ("theta_bar",)

    def infer_shape(self, node: Apply, input_shapes: Sequence) -> list[tuple]:
        """The shape of theta."""
        return [input_shapes[0]]


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
    if isinstance(compiled, PlannedFunction):
        function, key = compiled.source(), compiled.key
    else:
        function, key = _call(op, compiled)
    return numba_njit(function), key


def _call(op: FilterOp, compiled: CompiledFunction) -> tuple[Any, str | None]:
    """The function that checks the record, then calls a kernel without a plan; and its key.

    Kernels receive copies: constants and variables, C and Fortran order differ in type, and each
    combination of types would be compiled separately, which takes seconds where a copy takes
    nanoseconds. The function is written out for each operation; a loop over the inputs would cost
    time in every call and seconds of compilation.
    """
    names = [name for name, _, _ in op.input_types]
    codes = [
        op.argument_code.get(name, f"{name}.copy()" if ndim else f"{name}.item()")
        for name, _, ndim in op.input_types
    ]
    arguments = ", ".join(code for code in codes if code is not None)
    lines = [*op.record_checks, f"return run({arguments})"]
    source = f"def call({', '.join(names)}):\n" + "".join(f"    {line}\n" for line in lines)
    namespace = {
        "__name__": __name__,
        "np": np,
        "run": compiled.function,
        "check": check_record(op.system),
        "check_panel": check_panel(op.system),
        "check_observed": check_observed(op.system.p),
        "no_normals": np.empty(0),
    }
    exec(compile(source, f"<call of {type(op).__name__}>", "exec"), namespace)
    key = cache_key(op.system, compiled)
    return namespace["call"], key_of(__name__, source, key)
