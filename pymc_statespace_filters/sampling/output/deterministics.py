"""Constrained values and Deterministics of a PyMC model at many positions.

Most models compute simple functions of a position: transforms to the user's scale, ratios, sums.
`vectorize_graph` and NumPy evaluate these for thousands of positions at once, in nanoseconds each
and without compiling. The others (loops and likelihoods within Deterministics, triangular matrices)
are evaluated by one compiled function, called for each position.
"""

from collections.abc import Sequence
from functools import reduce

import numpy as np
from pymc.model import Model
from pymc.pytensorf import compile as compile_pymc
from pymc.util import get_default_varnames
from pytensor.compile.mode import Mode
from pytensor.compile.ops import ViewOp
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.fg import FunctionGraph
from pytensor.graph.rewriting.basic import in2out, node_rewriter
from pytensor.graph.rewriting.db import RewriteDatabaseQuery
from pytensor.graph.traversal import ancestors
from pytensor.scalar.basic import AND, OR, Invert, ScalarType, Switch
from pytensor.tensor.basic import (
    Alloc,
    Join,
    MakeVector,
    ScalarFromTensor,
    TensorFromScalar,
    constant,
)
from pytensor.tensor.blockwise import Blockwise
from pytensor.tensor.elemwise import CAReduce, DimShuffle, Elemwise
from pytensor.tensor.extra_ops import CumOp
from pytensor.tensor.shape import Shape
from pytensor.tensor.subtensor import Subtensor
from pytensor.tensor.type import TensorType
from pytensor.tensor.variable import TensorVariable

from ...compiler.native.rows import Rows, at_points
from ...pymc_model.density import compile_raveled
from ...pymc_model.written_function import native_function
from ..target.variables import RaveledVariables

# Positions in a block, whose intermediate results stay in the processor's cache.
BLOCK = 4096

# Operations that NumPy applies to a block in one call, in addition to its ufuncs.
VECTORIZED_OPS = (
    Alloc,
    CAReduce,
    CumOp,
    DimShuffle,
    Join,
    MakeVector,
    ScalarFromTensor,
    Shape,
    Subtensor,
    TensorFromScalar,
    ViewOp,
)

# Operations on booleans for which NumPy and machine code agree.
BOOLEAN_OPS = (AND, OR, Invert, Switch)


@node_rewriter([Elemwise])
def _binary_sums_and_products(fgraph: FunctionGraph, node: Apply) -> list[Variable] | None:
    """Split n-ary sums and products into binary ones, for which NumPy has ufuncs."""
    op, spec = node.op, node.op.nfunc_spec
    if spec is None or spec[1] != 2 or len(node.inputs) == 2:
        return None
    # Start with the dtype of the result: two small integers may overflow theirs.
    start = constant(op.scalar_op.identity, dtype=node.outputs[0].dtype)
    return [reduce(op, node.inputs, start)]


# PyTensor's usual rewrites, without those for compiled loops.
NUMPY_MODE = Mode(
    "py", RewriteDatabaseQuery(include=("fast_run",), exclude=("fusion", "inplace"))
).register((in2out(_binary_sums_and_products), 100.0))


class Deterministics:
    """The variables of a trace, in the order of ``pm.sample``, evaluated at positions of a chain.

    ``raveled`` has all value variables of the model.
    """

    def __init__(self, model: Model, raveled: RaveledVariables):
        wanted = get_default_varnames(model.unobserved_value_vars, include_transformed=False)
        self.names = [variable.name for variable in wanted]
        vectorized = _Vectorized([v for v in wanted if _is_vectorizable(v)], raveled)
        rest = [v for v in wanted if v.name not in vectorized.names]
        self._evaluators: list[_Vectorized | _PerPosition] = [vectorized]
        if rest:
            self._evaluators.append(_PerPosition(rest, raveled))

    def __call__(self, positions: np.ndarray) -> dict[str, np.ndarray]:
        """Values (n, ...) by name at positions (n, d); repeated rows are evaluated once."""
        moved = np.ones(len(positions), dtype=np.bool_)
        moved[1:] = (positions[1:] != positions[:-1]).any(axis=1)
        distinct, place = positions[moved], np.cumsum(moved) - 1
        values = {}
        for evaluate in self._evaluators:
            for name, array in zip(evaluate.names, evaluate(distinct), strict=True):
                values[name] = array[place]
        return {name: values[name] for name in self.names}


class _Vectorized:
    """Evaluates by NumPy, a block of positions at a time; skips variables that NumPy cannot.

    NumPy's functions may differ from those of machine code in the last bit.
    """

    def __init__(self, wanted: Sequence[TensorVariable], raveled: RaveledVariables):
        point = raveled.unravel(np.zeros(raveled.dim))
        self._shapes = [point[v.name].shape for v in raveled.variables]
        self._ends = np.cumsum([point[v.name].size for v in raveled.variables])[:-1]
        blocks, graphs = at_points(raveled.variables, wanted)
        kept = {
            v.name: graph
            for v, graph in zip(wanted, _without_views(graphs), strict=True)
            if _is_vectorizable(graph)
        }
        self.names = list(kept)
        self._dtypes = [block.dtype for block in blocks]
        self._function = compile_pymc(
            blocks,
            list(kept.values()),
            mode=NUMPY_MODE,
            on_unused_input="ignore",
            trust_input=True,
        )

    def __call__(self, positions: np.ndarray) -> list[np.ndarray]:
        results: list[np.ndarray] = []
        for begin in range(0, len(positions), BLOCK):
            block = positions[begin : begin + BLOCK]
            with np.errstate(all="ignore"):  # infinities and NaN are values, as in machine code
                values = self._function(*self._split(block))
            if not results:
                results = [np.empty((len(positions), *v.shape[1:]), v.dtype) for v in values]
            for result, value in zip(results, values, strict=True):
                result[begin : begin + BLOCK] = value
        return results

    def _split(self, block: np.ndarray) -> list[np.ndarray]:
        parts = np.split(block, self._ends, axis=1)
        return [
            part.reshape(len(block), *shape).astype(dtype, copy=False)
            for part, shape, dtype in zip(parts, self._shapes, self._dtypes, strict=True)
        ]


class _PerPosition:
    """Evaluates by machine code, one call for each position."""

    def __init__(self, wanted: Sequence[TensorVariable], raveled: RaveledVariables):
        self.names = [v.name for v in wanted]
        point = raveled.unravel(np.zeros(raveled.dim))
        self._function, _ = compile_raveled(point, wanted, raveled.variables)

    def __call__(self, positions: np.ndarray) -> list[np.ndarray]:
        # With the data as they are now.
        rows = Rows(native_function(self._function, [positions[0]]), 1, in_turn=True)
        return rows(positions)


def _is_vectorizable(graph: Variable) -> bool:
    """Whether NumPy evaluates a graph in a few calls per block."""
    return all(
        isinstance(v.type, TensorType | ScalarType)
        and (v.owner is None or _is_vectorized_op(v.owner))
        for v in ancestors([graph])
    )


def _is_vectorized_op(node: Apply) -> bool:
    op = node.op
    if isinstance(op, Elemwise):
        # NumPy's sum of two booleans is a boolean, machine code may count.
        is_counting = any(v.dtype == "bool" for v in node.inputs)
        # Without a ufunc of NumPy or SciPy, PyTensor would loop over the elements in Python.
        return op.nfunc_spec is not None and (
            isinstance(op.scalar_op, BOOLEAN_OPS) or not is_counting
        )
    return isinstance(op, VECTORIZED_OPS)


def _without_views(graphs: list[Variable]) -> list[Variable]:
    """Remove the views by which PyMC names Deterministics: vectorized, they loop in Python."""
    graph = FunctionGraph(outputs=graphs, clone=False)
    for node in graph.toposort():
        if isinstance(node.op, Blockwise) and isinstance(node.op.core_op, ViewOp):
            graph.replace(node.outputs[0], node.inputs[0])
    return list(graph.outputs)
