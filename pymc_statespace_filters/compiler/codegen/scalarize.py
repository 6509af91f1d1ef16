"""Unroll a PyTensor graph of small arrays into scalar expressions.

Every variable of the graph becomes a NumPy object array of expressions and Python constants. NumPy
runs the operations that only move elements (indexing, joining, reshaping) on those arrays;
elementwise operations, sums and small linear algebra are written out.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial, reduce
from typing import Any

import numpy as np
import pytensor.scalar as ps
import pytensor.tensor.basic as ptb
from pytensor.assumptions.specify import SpecifyAssumptions
from pytensor.compile.builders import OpFromGraph
from pytensor.compile.ops import DeepCopyOp, ViewOp
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.op import Op
from pytensor.graph.traversal import io_toposort
from pytensor.raise_op import CheckAndRaise
from pytensor.tensor.blockwise import Blockwise
from pytensor.tensor.elemwise import CAReduce, DimShuffle, Elemwise
from pytensor.tensor.linalg.decomposition.cholesky import Cholesky
from pytensor.tensor.linalg.inverse import MatrixInverse
from pytensor.tensor.linalg.solvers.general import Solve
from pytensor.tensor.linalg.solvers.psd import CholeskySolve
from pytensor.tensor.linalg.solvers.triangular import SolveTriangular
from pytensor.tensor.linalg.summary import Det
from pytensor.tensor.math import Dot
from pytensor.tensor.reshape import JoinDims, SplitDims
from pytensor.tensor.shape import Reshape, Shape, Shape_i, SpecifyShape
from pytensor.tensor.subtensor import (
    AdvancedIncSubtensor,
    AdvancedSubtensor,
    IncSubtensor,
    Subtensor,
    unflatten_index_variables,
)

from .expressions import Arena, Opaque, Value, is_constant, plain
from .scalar_linalg import (
    cholesky,
    cholesky_solve,
    determinant,
    inner,
    inverse,
    solve,
    solve_triangular,
)
from .semidefinite import SemidefiniteCholesky, unrolled_root


class NotUnrollableError(Exception):
    """The graph holds an operation without a scalar form, or is too large to write out."""


def unroll(
    arena: Arena,
    inputs: Sequence[Variable],
    values: Sequence[np.ndarray],
    outputs: Sequence[Variable],
    max_expressions: int,
    *,
    to_ask: bool = False,
) -> list[np.ndarray]:
    """Object arrays of scalar expressions for ``outputs``, given those for ``inputs``.

    If they are only ``to_ask`` what depends on what, linear algebra need not have a scalar form.
    """
    known: dict[Variable, np.ndarray] = dict(zip(inputs, values, strict=True))
    for node in io_toposort(inputs, outputs):
        arguments = [_value(known, variable) for variable in node.inputs]
        try:
            results = evaluate(arena, node, arguments)
        except NotUnrollableError:
            if not (to_ask and is_linear_algebra(node.op)):
                raise
            results = _opaque(arena, node, arguments)
        known.update(zip(node.outputs, map(objects, results), strict=True))
        if len(arena) > max_expressions:
            raise NotUnrollableError(f"more than {max_expressions} scalar operations")
    return [_value(known, variable) for variable in outputs]


def is_linear_algebra(op: Op) -> bool:
    """Whether an operation is one of PyTensor's linear algebra, beyond a product."""
    core = op.core_op if isinstance(op, Blockwise) else op
    of_pytensor = type(core).__module__.startswith("pytensor.tensor.linalg")
    return of_pytensor and not isinstance(core, Dot)


def _opaque(arena: Arena, node, arguments: list[np.ndarray]) -> list[np.ndarray]:
    """Results of an operation that is not written out, of all elements of its arguments."""
    op, given = Opaque(node.op), tuple(v for array in arguments for v in array.flat)
    results = []
    for i, output in enumerate(node.outputs):
        if None in output.type.shape:
            raise NotUnrollableError(f"the operation {node.op}")
        result = np.empty(output.type.shape, dtype=object)
        for element, index in enumerate(np.ndindex(result.shape)):
            result[index] = arena.opaque(op, (*given, i), element)
        results.append(result)
    return results


def _value(known: dict[Variable, np.ndarray], variable: Variable) -> np.ndarray:
    if variable not in known:
        if not isinstance(variable, Constant):
            raise NotUnrollableError(f"an input that is not an argument, {variable}")
        known[variable] = objects(variable.data)
    return known[variable]


def objects(array) -> np.ndarray:
    """Any value as an object array of expressions and Python scalars."""
    if isinstance(array, np.ndarray) and array.dtype == object:
        return array
    if array is None or isinstance(array, slice):  # a NoneConst or slice argument
        raise NotUnrollableError("an index that is not a number")
    if not isinstance(array, np.ndarray | np.generic | float | int | bool):
        return _as_array(array)
    numbers = np.asarray(array)
    out = np.empty(numbers.shape, dtype=object)
    for index in np.ndindex(numbers.shape):
        out[index] = plain(numbers[index])
    return out


def _numbers(node_input: Variable, value: np.ndarray) -> np.ndarray:
    """A constant object array as the numeric array that the operation expects."""
    if not all(is_constant(v) for v in value.flat):
        raise NotUnrollableError("an index or a shape that depends on the state or a parameter")
    return np.asarray(value.tolist(), dtype=node_input.type.dtype)


def evaluate(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    """The results of one operation, arrays or objects that become such."""
    for types, rule in _RULES:
        if isinstance(node.op, types):
            return rule(arena, node, arguments)
    if all(is_constant(v) for value in arguments for v in value.flat):
        return _perform(node, [_numbers(i, a) for i, a in zip(node.inputs, arguments, strict=True)])
    raise NotUnrollableError(f"the operation {node.op}")


def _perform(node, arguments: list) -> list:
    storage: list[list] = [[None] for _ in node.outputs]
    node.op.perform(node, arguments, storage)
    return [cell[0] for cell in storage]


def _move(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    """Run an operation that only moves elements of its first input; the others are numbers."""
    numbers = [_numbers(i, a) for i, a in zip(node.inputs[1:], arguments[1:], strict=True)]
    return _perform(node, [arguments[0], *numbers])


def _join(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    return [np.concatenate(arguments, axis=node.op.axis)]


def _scalars(arena: Arena, op: ps.ScalarOp, arguments: list) -> list:
    """The results of an operation on scalars, or of several that PyTensor has fused."""
    if not isinstance(op, ps.Composite):
        return [arena.apply(op, *arguments)]
    known = dict(zip(op.fgraph.inputs, arguments, strict=True))
    for node in op.fgraph.toposort():
        inner = [plain(i.data) if isinstance(i, Constant) else known[i] for i in node.inputs]
        known.update(zip(node.outputs, _scalars(arena, node.op, inner), strict=True))
    return [plain(o.data) if isinstance(o, Constant) else known[o] for o in op.fgraph.outputs]


def _elemwise(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    op = node.op.scalar_op if isinstance(node.op, Elemwise) else node.op
    arrays = np.broadcast_arrays(*arguments)
    results = [np.empty(arrays[0].shape, dtype=object) for _ in node.outputs]
    for index in np.ndindex(arrays[0].shape):
        values = _scalars(arena, op, [array[index] for array in arrays])
        for result, value in zip(results, values, strict=True):
            result[index] = value
    return results


def _reduce(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    (array,) = arguments
    axes = tuple(range(array.ndim)) if node.op.axis is None else tuple(node.op.axis)
    kept = [axis for axis in range(array.ndim) if axis not in axes]
    # A sum of booleans is a count.
    counts = node.inputs[0].type.dtype == "bool" and node.outputs[0].type.dtype != "bool"
    cast = ps.Cast(ps.get_scalar_type(node.outputs[0].type.dtype))
    rows = np.transpose(array, (*kept, *axes)).reshape(*(array.shape[a] for a in kept), -1)
    out = np.empty(rows.shape[:-1], dtype=object)
    for index in np.ndindex(out.shape):
        terms = [arena.apply(cast, term) for term in rows[index]] if counts else list(rows[index])
        identity = plain(np.asarray(getattr(node.op.scalar_op, "identity", 0)))
        out[index] = reduce(lambda a, b: arena.apply(node.op.scalar_op, a, b), terms or [identity])
    return [out]


def _dot(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    a, b = arguments
    out = np.empty((a.shape[0], b.shape[1]), dtype=object)
    is_square = a.shape == b.T.shape and all(x is y for x, y in zip(a.flat, b.T.flat, strict=True))
    for i, j in np.ndindex(out.shape):
        mirrored = is_square and j < i  # of a matrix with its own transpose
        out[i, j] = out[j, i] if mirrored else inner(arena, a[i, :], b[:, j])
    return [out]


def _blockwise(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    core_inputs = node.op.inputs_sig
    batches = [a.shape[: a.ndim - len(sig)] for a, sig in zip(arguments, core_inputs, strict=True)]
    batch = np.broadcast_shapes(*batches)
    spread = [
        np.broadcast_to(a, batch + a.shape[a.ndim - len(sig) :])
        for a, sig in zip(arguments, core_inputs, strict=True)
    ]
    core_node = node.op._create_dummy_core_node(node.inputs)
    results: list[np.ndarray] = []
    for index in np.ndindex(batch):
        core_arguments = [_as_array(array[index]) for array in spread]
        cores = [objects(r) for r in evaluate(arena, core_node, core_arguments)]
        if not results:
            results = [np.empty(batch + c.shape, dtype=object) for c in cores]
        for result, core in zip(results, cores, strict=True):
            result[index] = core if core.shape else core[()]
    return results


def _as_array(element) -> np.ndarray:
    """An element of an object array as an array, if only of no dimension."""
    if isinstance(element, np.ndarray):
        return element
    out = np.empty((), dtype=object)
    out[()] = element
    return out


def _subtensor(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    source, *indices = arguments
    chosen: np.ndarray | None = None
    for holds, numbers in _choices(arena, source.shape, node.op, indices):
        part = _as_array(source[_index(node, node.inputs[1:], numbers)])
        if holds is True:
            return [part]
        # An index that is none of these is out of range.
        rest = np.full(part.shape, np.nan, dtype=object) if chosen is None else chosen
        chosen = _where(arena, holds, part, rest)
    if chosen is None:
        raise NotUnrollableError("an index into nothing")
    return [chosen]


def _choices(
    arena: Arena, shape: Sequence[int], op, indices: list[np.ndarray]
) -> Iterator[tuple[Value, list[np.ndarray]]]:
    """Numbers that an index which depends on the state or a parameter may be, and when it is.

    The condition is True where all indices are numbers. One may be a scalar that is not.
    """
    unknown = [i for i, a in enumerate(indices) if not all(map(is_constant, a.flat))]
    if not unknown:
        yield True, indices
        return
    place, *others = unknown
    axes = [
        axis for axis, entry in enumerate(op.idx_list) if isinstance(entry, int) and entry == place
    ]
    if others or not axes or indices[place].ndim:
        raise NotUnrollableError("slices or several indices that depend on the state")
    size = shape[axes[0]]
    index: Any = indices[place][()]
    is_negative = arena.apply(ps.lt, index, 0)
    index = arena.apply(ps.switch, is_negative, arena.apply(ps.add, index, size), index)
    for k in range(size):
        numbers = [*indices[:place], _as_array(k), *indices[place + 1 :]]
        yield arena.apply(ps.eq, index, k), numbers


def _inc_subtensor(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    target, update, *indices = arguments
    for holds, numbers in _choices(arena, target.shape, node.op, indices):
        (changed,) = _changed(arena, node, target, update, numbers)
        if holds is True:
            return [changed]
        target = _where(arena, holds, changed, target)
    return [target]


def _where(arena: Arena, holds: Value, yes: np.ndarray, no: np.ndarray) -> np.ndarray:
    """A choice between the elements of two arrays of one shape."""
    out = np.empty(yes.shape, dtype=object)
    for index in np.ndindex(yes.shape):
        choices: list[Any] = [yes[index], no[index]]
        out[index] = arena.apply(ps.switch, holds, *choices)
    return out


def _changed(arena: Arena, node, target: np.ndarray, update: np.ndarray, indices: list) -> list:
    """A target in which the elements at indices that are numbers are set or increased."""
    where = _index(node, node.inputs[2:], indices)
    positions = np.arange(target.size).reshape(target.shape)[where]
    updates = np.broadcast_to(update, np.shape(positions))
    out = target.copy()
    for index in np.ndindex(np.shape(positions)):
        place: Any = np.unravel_index(np.asarray(positions)[index], target.shape)
        new: Any = updates[index]
        out[place] = new if node.op.set_instead_of_inc else arena.apply(ps.add, out[place], new)
    return [out]


def _index(node, variables: Sequence[Variable], values: list[np.ndarray]) -> tuple:
    numbers = [_numbers(v, a) for v, a in zip(variables, values, strict=True)]
    flat = [int(a) if a.ndim == 0 else a for a in numbers]
    return tuple(unflatten_index_variables(flat, node.op.idx_list))


def _make_vector(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    out = np.empty(len(arguments), dtype=object)
    out[:] = [a[()] for a in arguments]
    return [out]


def _alloc(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    shape = tuple(int(_numbers(i, a)) for i, a in zip(node.inputs[1:], arguments[1:], strict=True))
    return [np.broadcast_to(arguments[0], shape).copy()]


def _check(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    """A parameter check of a PyMC distribution: NaN where it fails, there is no density."""
    value, *conditions = arguments
    for condition in conditions:
        holds: Value = True
        for each in condition.flat:
            holds = arena.apply(ps.and_, holds, each)
        where_it_holds = np.frompyfunc(partial(arena.apply, ps.switch, holds), 2, 1)
        value = _as_array(where_it_holds(value, float("nan")))
    return [value]


def _inner_graph(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    graph = node.op.fgraph
    return unroll(arena, graph.inputs, arguments, graph.outputs, max_expressions=10**9)


def _shape(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    shape = np.asarray(arguments[0].shape, dtype="int64")
    return [shape[node.op.i] if isinstance(node.op, Shape_i) else shape]


def _same(arena: Arena, node, arguments: list[np.ndarray]) -> list:
    return [arguments[0]]


_RULES: tuple[tuple[tuple[type, ...], Callable], ...] = (
    ((Elemwise, ps.ScalarOp), _elemwise),
    ((CAReduce,), _reduce),
    ((Dot,), _dot),
    ((Cholesky,), cholesky),
    ((SemidefiniteCholesky,), unrolled_root),
    ((SolveTriangular,), solve_triangular),
    ((CholeskySolve,), cholesky_solve),
    ((Solve,), solve),
    ((MatrixInverse,), inverse),
    ((Det,), determinant),
    ((Blockwise,), _blockwise),
    ((Subtensor, AdvancedSubtensor), _subtensor),
    ((IncSubtensor, AdvancedIncSubtensor), _inc_subtensor),
    ((ptb.MakeVector,), _make_vector),
    ((ptb.Alloc,), _alloc),
    ((Shape, Shape_i), _shape),
    ((CheckAndRaise,), _check),
    ((OpFromGraph,), _inner_graph),
    ((SpecifyShape, SpecifyAssumptions, ViewOp, DeepCopyOp), _same),
    ((ptb.TensorFromScalar, ptb.ScalarFromTensor), _same),
    ((DimShuffle, ptb.ExtractDiag), _move),
    ((Reshape, JoinDims, SplitDims, ptb.Split), _move),
    ((ptb.Join,), _join),
)
