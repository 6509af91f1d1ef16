"""Which axis of each variable in a graph runs over records, and where records are mixed.

The value of a free variable has a row for each record. A variable of the graph is aligned if one
of its axes has entries that each depend on the rows of a single record, besides on what all records
share. An operation that is not known here, such as a sum over records, mixes them.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import singledispatch
from typing import Any, NamedTuple

import numpy as np
import pytensor
from pytensor.graph.basic import Apply, Constant, Variable
from pytensor.graph.traversal import graph_inputs, io_toposort
from pytensor.raise_op import CheckAndRaise
from pytensor.tensor.basic import Alloc, Join
from pytensor.tensor.blockwise import Blockwise
from pytensor.tensor.elemwise import CAReduce, DimShuffle, Elemwise
from pytensor.tensor.extra_ops import CumOp
from pytensor.tensor.math import Dot
from pytensor.tensor.shape import Reshape, Shape, Shape_i, SpecifyShape
from pytensor.tensor.special import LogSumExp, Softmax
from pytensor.tensor.subtensor import AdvancedSubtensor, Subtensor

from ..ops.likelihood import LogLikelihood
from ..ops.signatures import PANEL
from ..system.panel_records import RECORD


class Aligned(NamedTuple):
    """An axis whose entries belong to one record each: ``records`` has the number of each."""

    axis: int
    records: tuple[int, ...]


class Mixed(NamedTuple):
    """A variable that cannot be divided by record; the values by which it first was mixed."""

    values: frozenset[Variable]


Status = Aligned | Mixed | None  # None: it depends on no value


def follow(
    graphs: Sequence[Variable], values: Iterable[Variable], n_records: int, point: Mapping[str, Any]
) -> dict[Variable, Status]:
    """The status of every variable of the graphs.

    The ``values`` of free variables have a first axis that runs over the records. Any ``point`` of
    the model tells the lengths of its variables.
    """
    values = list(values)
    rows = tuple(range(n_records))
    found: dict[Variable, Status] = {value: Aligned(0, rows) for value in values}
    behind: dict[Variable, frozenset[Variable]] = {value: frozenset([value]) for value in values}
    for node in io_toposort(values, list(graphs)):
        inputs = [found.get(variable) for variable in node.inputs]
        if all(status is None for status in inputs) or isinstance(node.op, Shape | Shape_i):
            continue
        through = _union(behind.get(variable, frozenset()) for variable in node.inputs)
        if isinstance(node.op, CheckAndRaise):  # its conditions change no number
            status = inputs[0]
        elif mixed := [status for status in inputs if isinstance(status, Mixed)]:
            status = Mixed(_union(one.values for one in mixed))
        else:
            status = _aligned(node.op, node, inputs, point)
            if status is None:
                elsewhere = _union(
                    behind[variable]
                    for variable, one in zip(node.inputs, inputs, strict=True)
                    if isinstance(one, Aligned) and one.records != rows
                )
                status = Mixed(_smallest(elsewhere or through))
        for output in node.outputs:
            found[output], behind[output] = status, through
    return found


def _union(sets: Iterable[frozenset[Variable]]) -> frozenset[Variable]:
    empty: frozenset[Variable] = frozenset()
    return empty.union(*sets)


def _smallest(values: frozenset[Variable]) -> frozenset[Variable]:
    """The values of the fewest dimensions: a vector along another axis of a table gives way."""
    fewest = min(value.type.ndim for value in values)
    return frozenset(value for value in values if value.type.ndim == fewest)


def _common(statuses: Iterable[Aligned | None]) -> Aligned | None:
    """The one status of all that have one; None if they differ."""
    distinct = {status for status in statuses if status is not None}
    return distinct.pop() if len(distinct) == 1 else None


@singledispatch
def _aligned(op: Any, node: Apply, inputs: Sequence[Any], point: Mapping) -> Aligned | None:
    """The alignment of a node's outputs, given that of its inputs; None if records are mixed."""
    return None


@_aligned.register
def _elemwise(op: Elemwise, node: Apply, inputs: Sequence[Any], point: Mapping) -> Aligned | None:
    return _common(inputs)


@_aligned.register
def _dim_shuffle(
    op: DimShuffle, node: Apply, inputs: Sequence[Any], point: Mapping
) -> Aligned | None:
    axis, records = inputs[0]
    order = list(op.new_order)
    return Aligned(order.index(axis), records) if axis in order else None


@_aligned.register(CAReduce)
@_aligned.register(LogSumExp)
def _reduction(op: Any, node: Apply, inputs: Sequence[Any], point: Mapping) -> Aligned | None:
    axis, records = inputs[0]
    reduced = range(node.inputs[0].type.ndim) if op.axis is None else op.axis
    if axis in reduced:
        return None
    return Aligned(axis - sum(other < axis for other in reduced), records)


@_aligned.register(CumOp)
@_aligned.register(Softmax)
def _along_others(
    op: CumOp | Softmax, node: Apply, inputs: Sequence[Any], point: Mapping
) -> Aligned | None:
    axes = op.axis if isinstance(op.axis, tuple) else (op.axis,)
    return None if inputs[0].axis in axes or None in axes else inputs[0]


@_aligned.register
def _join(op: Join, node: Apply, inputs: Sequence[Any], point: Mapping) -> Aligned | None:
    status = _common(inputs)
    return None if status is None or status.axis == op.axis else status


@_aligned.register(Alloc)
def _allocation(op: Alloc, node: Apply, inputs: Sequence[Any], point: Mapping) -> Aligned | None:
    if inputs[0] is None:
        return None
    axis, records = inputs[0]
    return Aligned(axis + node.outputs[0].type.ndim - node.inputs[0].type.ndim, records)


@_aligned.register
def _checked_shape(
    op: SpecifyShape, node: Apply, inputs: Sequence[Any], point: Mapping
) -> Aligned | None:
    return inputs[0]


@_aligned.register
def _reshaped(op: Reshape, node: Apply, inputs: Sequence[Any], point: Mapping) -> Aligned | None:
    """The rows are kept if there are as many as before."""
    status = inputs[0]
    if status is None or inputs[1] is not None or status.axis != 0 or not op.ndim:
        return None
    lengths = [node.inputs[0].shape[0], node.outputs[0].shape[0]]
    before, after = evaluated(lengths, point)
    return status if before == after else None


def evaluated(graphs: Sequence[Variable], point: Mapping) -> list[Any]:
    """Numbers of graphs at a point; few, so not worth machine code."""
    values = [v for v in dict.fromkeys(graph_inputs(graphs)) if v.name in point]
    function = pytensor.function(values, list(graphs), mode="FAST_COMPILE")
    return function(*(point[v.name] for v in values))


@_aligned.register
def _part(op: Subtensor, node: Apply, inputs: Sequence[Any], point: Mapping) -> Aligned | None:
    """The whole axis must be taken."""
    if inputs[0] is None or any(inputs[1:]):
        return None
    axis, records = inputs[0]
    if axis < len(op.idx_list) and op.idx_list[axis] != slice(None):
        return None
    dropped = sum(isinstance(entry, int) for entry in op.idx_list[:axis])
    return Aligned(axis - dropped, records)


@_aligned.register
def _chosen(
    op: AdvancedSubtensor, node: Apply, inputs: Sequence[Any], point: Mapping
) -> Aligned | None:
    """One vector of known numbers along the axis, or along another one."""
    if inputs[0] is None or any(inputs[1:]):
        return None
    axis, records = inputs[0]
    indexed = [i for i, entry in enumerate(op.idx_list) if isinstance(entry, int)]
    sliced = [entry for entry in op.idx_list if isinstance(entry, slice) and entry != slice(None)]
    if sliced or len(indexed) != 1:
        return None
    index = node.inputs[1 + op.idx_list[indexed[0]]]
    if index.type.ndim != 1 or index.type.dtype == "bool":
        return None
    if indexed[0] != axis:
        return inputs[0]
    if not isinstance(index, Constant):
        return None
    return Aligned(axis, tuple(np.asarray(records)[index.data].tolist()))


@_aligned.register
def _product(op: Dot, node: Apply, inputs: Sequence[Any], point: Mapping) -> Aligned | None:
    """Rows of the first matrix, or columns of the second."""
    first, second = inputs
    if second is None and first.axis == 0:
        return first
    if first is None and second.axis == 1:
        return second
    return None


@_aligned.register
def _blockwise(op: Blockwise, node: Apply, inputs: Sequence[Any], point: Mapping) -> Aligned | None:
    """Along the axes of the batch, which all inputs and outputs have first."""
    status = _common(inputs)
    n_batch = op.batch_ndim(node)
    if status is not None and status.axis < n_batch:
        return status
    if status is not None and isinstance(op.core_op, Dot):
        axes = [None if one is None else one._replace(axis=one.axis - n_batch) for one in inputs]
        core = _product(op.core_op, node, axes, point)
        return None if core is None else core._replace(axis=core.axis + n_batch)
    return None


@_aligned.register
def _likelihood_of_panel(
    op: LogLikelihood, node: Apply, inputs: Sequence[Any], point: Mapping
) -> Aligned | None:
    """From a row of parameters for each record to the terms of its rows."""
    if op.form != PANEL or inputs[0] is None or inputs[0].axis != 0 or any(inputs[1:]):
        return None
    records = np.asarray(inputs[0].records)
    return Aligned(0, tuple(records[records_of_rows(node.inputs[1])].tolist()))


def records_of_rows(rows: Variable) -> np.ndarray:
    """The number of the record of each row of a panel, (J,), from its current rows."""
    codes = evaluated([rows], {})[0][:, RECORD]
    return np.concatenate([[0], np.cumsum(codes[1:] != codes[:-1])])
