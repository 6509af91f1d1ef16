"""Frozen graphs: equal if the equations are equal, picklable, described alike in every process."""

import hashlib
from collections.abc import Sequence

import numpy as np
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.graph.traversal import graph_inputs

from pymc_statespace_filters.errors import ModelError


def freeze(inputs: Sequence[Variable], outputs: Sequence[Variable]) -> FrozenFunctionGraph:
    """The graph from ``inputs`` to ``outputs``, immutable and hashable."""
    for variable in graph_inputs(outputs):
        if variable not in inputs and not isinstance(variable, Constant):
            kind = "shared variable" if isinstance(variable, SharedVariable) else "symbol"
            raise ModelError(
                f"a function of the system uses the {kind} {variable} from outside; pass it as a "
                f"parameter, or as a plain number or numpy array if it is a constant"
            )
    return FrozenFunctionGraph.from_io(inputs, outputs)


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
