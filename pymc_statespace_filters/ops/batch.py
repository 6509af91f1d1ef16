"""The log-likelihood at many parameter points for one record, as a single operation."""

from collections.abc import Sequence

import pytensor.tensor as pt
from pytensor.gradient import DisconnectedType
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.replace import _vectorize_node
from pytensor.tensor.blockwise import Blockwise

from ..compiler.lowering.compiled_system import CompiledSystem
from ..filters.protocol import BatchFilter, Compiled
from .base import HEALTH_SIZE, RECORD_INPUTS, FilterOp, theta_cotangent_only
from .likelihood import LogLikelihood, LogLikelihoodGradient


class BatchLogLikelihood(FilterOp):
    """`LogLikelihood` of many points: theta (B, k) -> terms (B, J), health (B, 3)."""

    filter: BatchFilter
    input_types = (("theta", "float64", 2), *RECORD_INPUTS[1:])
    output_types = (pt.dmatrix, pt.dmatrix)

    def compile(self, system: CompiledSystem) -> Compiled:
        """The filter's log-likelihood of many points."""
        return self.filter.compile_batch(system)

    def infer_shape(self, node: Apply, input_shapes: Sequence) -> list[tuple]:
        """A row for every point."""
        n_points = input_shapes[0][0]
        return [(n_points, input_shapes[1][0]), (n_points, HEALTH_SIZE)]

    def pullback(
        self,
        inputs: Sequence[Variable],
        outputs: Sequence[Variable],
        cotangents: Sequence[Variable],
    ) -> list[Variable]:
        """Reverse-mode derivative by theta, point by point."""
        theta_bar = pt.zeros_like(inputs[0])
        if not isinstance(cotangents[0].type, DisconnectedType):
            gradient = Blockwise(LogLikelihoodGradient(self.system, self.filter))
            theta_bar = gradient(*inputs, cotangents[0])
        return theta_cotangent_only(self, inputs, theta_bar)


def has_batch(op: LogLikelihood) -> bool:
    """Whether the filter of the operation evaluates many points side by side."""
    return isinstance(op.filter, BatchFilter)


def vectorized(op: LogLikelihood, theta: Variable, *record: Variable) -> list[Variable]:
    """Terms and health over leading dimensions, of the parameters alone or of any input."""
    cores = [ndim for _, _, ndim in RECORD_INPUTS[1:]]
    extra = [value.type.ndim - ndim for value, ndim in zip(record, cores, strict=True)]
    if theta.type.ndim == 1 and not any(extra):
        return op(theta, *record, return_list=True)
    one_record = max(extra) < theta.type.ndim and all(
        length == 1
        for value, n in zip(record, extra, strict=True)
        for length in value.type.shape[:n]
    )
    if not (one_record and theta.type.ndim > 1 and has_batch(op)):
        return Blockwise(op)(*[theta, *record], return_list=True)
    record = tuple(value[(0,) * n] if n else value for value, n in zip(record, extra, strict=True))
    shape = tuple(theta.shape)[:-1]
    batch = BatchLogLikelihood(op.system, op.filter)
    if len(shape) == 1:
        return batch(theta, *record)
    points = theta.reshape((pt.prod(pt.stack(shape)), theta.shape[-1]))
    results = batch(points, *record)
    return [result.reshape((*shape, result.shape[-1])) for result in results]


@_vectorize_node.register(LogLikelihood)
def _vectorize(op: LogLikelihood, node: Apply, *inputs: Variable) -> list[Variable]:
    return vectorized(op, *inputs)
