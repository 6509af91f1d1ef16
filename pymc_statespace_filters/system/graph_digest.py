"""Frozen graphs of equations, and their canonical text, the same in every process."""

import hashlib
from collections.abc import Sequence

import numpy as np
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.graph.traversal import ancestors, graph_inputs
from pytensor.tensor.random.type import RandomType
from pytensor.tensor.subtensor import Subtensor, unflatten_index_variables

from pymc_statespace_filters.errors import ModelError


def freeze(inputs: Sequence[Variable], outputs: Sequence[Variable]) -> FrozenFunctionGraph:
    """The graph from ``inputs`` to ``outputs``, immutable and hashable."""
    for variable in graph_inputs(outputs):
        if variable not in inputs and not isinstance(variable, Constant):
            raise ModelError(
                f"a function of the system must use its arguments and constants only, got the "
                f"{_kind(variable, outputs)}; pass it as a parameter, or as a number or array if "
                f"it is constant"
            )
    _check_indices(outputs)
    return FrozenFunctionGraph.from_io(inputs, outputs)


def _kind(variable: Variable, outputs: Sequence[Variable]) -> str:
    """How to call an outside variable in a message; a generator is named by what it draws."""
    if not isinstance(variable, SharedVariable):
        return f"symbol {variable}"
    if not isinstance(variable.type, RandomType):
        return f"shared variable {variable}"
    drawn = [v for v in ancestors(outputs) if v.owner is not None and variable in v.owner.inputs]
    return f"random variable {drawn[0].name or drawn[0]}"


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


def describe(graph: FrozenFunctionGraph | None) -> str:
    """A text that is equal for equal graphs, in any process."""
    if graph is None:
        return "none"
    numbers: dict[Variable, str] = {v: f"i{i}:{v.type}" for i, v in enumerate(graph.inputs)}
    lines: list[str] = []
    for node in graph.toposort():
        arguments = [_describe_input(numbers, variable) for variable in node.inputs]
        for i, output in enumerate(node.outputs):
            numbers[output] = f"n{len(lines)}.{i}"
        lines.append(f"{_describe_op(node.op)}({', '.join(arguments)})")
    outputs = [_describe_input(numbers, variable) for variable in graph.outputs]
    return "\n".join([*lines, f"-> {', '.join(outputs)}"])


def _describe_input(numbers: dict[Variable, str], variable: Variable) -> str:
    if not isinstance(variable, Constant):
        return numbers[variable]
    if not isinstance(variable.data, np.ndarray | np.generic | int | float):
        return f"{variable.type}:{variable.data!r}"
    data = np.asarray(variable.data)
    return f"{data.dtype}{data.shape}{hashlib.sha256(data.tobytes()).hexdigest()}"


def _describe_op(op) -> str:
    inner = describe(op.fgraph) if hasattr(op, "fgraph") else ""
    properties = {}
    for name in getattr(op, "__props__", None) or ():
        value = getattr(op, name)
        properties[name] = _describe_op(value) if hasattr(value, "make_node") else str(value)
    return f"{type(op).__module__}.{type(op).__qualname__}{properties}{inner}"
