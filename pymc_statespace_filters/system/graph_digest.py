"""Frozen graphs of equations, and digests of graphs and values that agree in every process.

Each variable of a graph has a digest, made of its operation and of the digests of its inputs, down
to constants and to inputs by name. Neither addresses nor the order of sets matter.
"""

import enum
import hashlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import singledispatch
from types import FunctionType
from typing import Any

import numpy as np
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.fg import FrozenFunctionGraph, FunctionGraph
from pytensor.graph.op import Op
from pytensor.graph.traversal import ancestors, graph_inputs, io_toposort
from pytensor.graph.type import Type
from pytensor.tensor.random.type import RandomType
from pytensor.tensor.subtensor import Subtensor, unflatten_index_variables

from ..errors import ModelError

# Where the noise of a function belongs, by the function's name in messages.
_NOISE_OF = {
    "transition": "the noise of a step is the argument q of the transition, with the covariance "
    "process_noise, or the diffusion of an integrator",
    "observation": "noise of the observation is given by observation_noise, or by "
    "observation_dist as a distribution for each observable",
    "observation_dist": "a distribution with random parameters must be given by its own density, "
    "such as pm.NegativeBinomial for a Poisson with a Gamma rate, or these become states",
    "initial_mean": "the spread of the initial state is initial_cov",
}


def freeze(
    inputs: Sequence[Variable], outputs: Sequence[Variable], role: str = "a function of the system"
) -> FrozenFunctionGraph:
    """The graph from ``inputs`` to ``outputs``, immutable and hashable; messages name ``role``."""
    for variable in graph_inputs(outputs):
        if variable in inputs or isinstance(variable, Constant):
            continue
        if (drawn := _drawn_from(variable, outputs)) is not None:
            _check_made_before(drawn, inputs, role)
        raise ModelError(
            f"{role} must use its arguments and constants only, got the "
            f"{_kind(variable, drawn)}; pass it as a parameter, or as a number or array if "
            f"it is constant"
        )
    _check_indices(outputs)
    return FrozenFunctionGraph.from_io(inputs, outputs)


def _drawn_from(generator: Variable, outputs: Sequence[Variable]) -> Variable | None:
    """The random variable that is drawn from a generator; None for any other variable."""
    if not isinstance(generator.type, RandomType):
        return None
    return next(v for v in ancestors(outputs) if v.owner and generator in v.owner.inputs)


def _check_made_before(drawn: Variable, inputs: Sequence[Variable], role: str) -> None:
    """Raise if a random variable was made inside the function that was called with ``inputs``."""
    if is_made_after(drawn, inputs):
        remedy = f": {_NOISE_OF[role]}" if role in _NOISE_OF else ""
        name = getattr(drawn.owner.op, "name", None) or drawn
        raise ModelError(
            f"{role} must be a deterministic function of its arguments, got the random variable "
            f"{name}, made inside it{remedy}"
        )


def is_made_after(variable: Variable, inputs: Sequence[Variable]) -> bool:
    """Whether a variable is younger than the first of the inputs, whose function made it then."""
    return _serial_number(variable) > min(map(_serial_number, inputs))


def _serial_number(variable: Variable) -> int:
    """A number that grows with every variable that PyTensor makes."""
    return int(variable.auto_name.removeprefix("auto_"))


def _kind(variable: Variable, drawn: Variable | None) -> str:
    """How to call an outside variable in a message; a generator is named by what it draws."""
    if drawn is not None:
        return f"random variable {drawn.name or drawn}"
    return f"{'shared variable' if isinstance(variable, SharedVariable) else 'symbol'} {variable}"


def _check_indices(outputs: Sequence[Variable]) -> None:
    """Raise for a constant index out of range; machine code would not check it."""
    for variable in ancestors(outputs):
        if variable.owner is None or not isinstance(variable.owner.op, Subtensor):
            continue
        source, *indices = variable.owner.inputs
        numbers = [i.data if isinstance(i, Constant) else None for i in indices]
        where = unflatten_index_variables(numbers, variable.owner.op.idx_list)
        for index, size in zip(where, source.type.shape, strict=False):
            whole = isinstance(index, np.ndarray | np.integer | int)
            if whole and size is not None and not -size <= index < size:
                raise ModelError(
                    f"a function of the system must index {source} from 0 to {size - 1}, got the "
                    f"index {int(index)}"
                )


def graph_digest(outputs: Sequence[Variable], known: Mapping[Variable, str]) -> str:
    """A digest of what the outputs compute.

    ``known`` holds digests of inputs; other inputs are identified by order, name and type. Equal
    subgraphs have equal digests, whether they are one node or several.
    """
    digests = dict(known)
    n_unknown = 0

    def look_up(variable: Variable) -> str:
        nonlocal n_unknown
        if variable not in digests:
            if isinstance(variable, Constant):
                root = variable.data
            else:
                root = (n_unknown, variable.name)
                n_unknown += 1
            digests[variable] = digest(described(variable, [variable.type, root]))
        return digests[variable]

    for node in io_toposort(list(known), list(outputs)):
        arguments = [look_up(variable) for variable in node.inputs]
        operation = describe(node.op)
        for i, output in enumerate(node.outputs):
            digests[output] = digest(operation, describe(output.type), i, *arguments)
    return digest(*map(look_up, outputs))


def digest(*parts: str | int) -> str:
    """Hexadecimal SHA-256 of some texts."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()


class _UnstableError(Exception):
    """A value whose text differs between processes."""


def described(what: object, value: Any) -> str:
    """Describe a value; the error of a value that cannot be described names ``what`` it is."""
    try:
        return describe(value)
    except _UnstableError as error:
        raise ModelError(
            f"{what} must have a text that is the same in every process, got {error}; without one "
            f"it cannot be recognised in another process, and no run resumed from a checkpoint"
        ) from None


@singledispatch
def describe(value: Any) -> str:
    """A text that is equal for equal values, in every process."""
    if is_dataclass(value):
        compared = [field.name for field in fields(value) if field.compare]
        return _of(value, {name: getattr(value, name) for name in compared})
    text = repr(value)
    if text.startswith("<") or " at 0x" in text:
        raise _UnstableError(text)
    return f"{_name(type(value))}:{text}"


def _name(value: type | FunctionType) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def _of(value: object, parts: Mapping[str, Any]) -> str:
    return f"{_name(type(value))}{describe(dict(parts))}"


@describe.register(bool | int | float | complex | str | bytes | None)
def _(value: Any) -> str:
    return repr(value)


@describe.register(np.ndarray | np.generic)
def _(value: Any) -> str:
    array = np.asarray(value)
    if array.dtype.hasobject:
        return f"{array.shape}{describe(array.ravel().tolist())}"
    content = array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
    return f"{array.dtype}{array.shape}{hashlib.sha256(content).hexdigest()}"


@describe.register(tuple | list)
def _(value: Any) -> str:
    return f"{_name(type(value))}({', '.join(map(describe, value))})"


@describe.register(slice)
def _(value: slice) -> str:
    return f"slice{describe((value.start, value.stop, value.step))}"


@describe.register(set | frozenset)
def _(value: Any) -> str:
    return f"set({', '.join(sorted(map(describe, value)))})"


@describe.register
def _(value: Mapping) -> str:
    items = sorted((describe(key), describe(item)) for key, item in value.items())
    return f"{{{', '.join(f'{key}: {item}' for key, item in items)}}}"


@describe.register
def _(value: enum.Enum) -> str:
    return f"{_name(type(value))}.{value.name}"


@describe.register
def _(value: type) -> str:
    return _name(value)


@describe.register
def _(value: FunctionType) -> str:
    found: Any = sys.modules.get(value.__module__)
    for part in value.__qualname__.split("."):
        found = getattr(found, part, None)
    if found is not value:
        raise _UnstableError(f"the function {value!r}")
    return _name(value)


@describe.register
def _(value: Variable) -> str:
    return graph_digest([value], {})


@describe.register(FunctionGraph | FrozenFunctionGraph)
def _(value: Any) -> str:
    inputs = {v: digest("input", i, describe(v.type)) for i, v in enumerate(value.inputs)}
    return graph_digest(value.outputs, inputs)


@describe.register
def _(value: Type) -> str:
    names = getattr(value, "__props__", vars(value))
    return _of(value, {name: getattr(value, name) for name in names})


@describe.register
def _(value: Op) -> str:
    kind = _name(type(value))
    parts = [
        f"{name}={described(f'{name!r} of the operation {kind}', setting)}"
        for name, setting in _settings(value).items()
    ]
    return f"{kind}({', '.join(parts)})"


# Settings of loops and optimisers beside their inner graph.
_AROUND_A_GRAPH = ("info", "truncate_gradient", "method", "optimizer_kwargs", "bound_kwargs")


def _settings(op: Op) -> dict[str, Any]:
    """Settings of an operation: its properties, else all its attributes; and its inner graph."""
    names = getattr(op, "__props__", _AROUND_A_GRAPH if hasattr(op, "fgraph") else vars(op))
    settings = {name: getattr(op, name) for name in names if hasattr(op, name)}
    settings.pop("output_types_preference", None)  # a function; the types themselves are described
    if hasattr(op, "fgraph"):
        settings["fgraph"] = op.fgraph
    return settings
