"""Value and gradient together: one pass forwards that leaves a tape, and one pass back over it.

`LogLikelihood` and `LogLikelihoodGradient` stand for themselves, so that a graph may hold either
alone. Where one graph holds both at the same inputs, a rewrite puts the two operations
of this file in their place.
"""

from collections.abc import Sequence
from typing import Any

import pytensor.tensor as pt
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.fg import FunctionGraph
from pytensor.graph.rewriting.basic import node_rewriter
from pytensor.link.numba.dispatch.basic import numba_njit, register_funcify_and_cache_key
from pytensor.tensor.rewriting.basic import register_specialize

from pymc_statespace_filters.lowering import Compiled
from pymc_statespace_filters.ops.gradient import LogLikelihoodGradient
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.ops.record import (
    RECORD_INPUTS,
    RecordOp,
    cache_key,
    check_observed,
    check_record,
    kernel,
)


class TapedLogLikelihood(RecordOp):
    """`LogLikelihood` with a third output, the tape: a state of the filter in each row."""

    def compile(self) -> Compiled:
        """The pass forwards."""
        return self.filter.compile_taped(self.system)  # type: ignore[union-attr]

    def results(self) -> list[Variable]:
        """Terms, health and tape."""
        return [pt.dvector(), pt.dvector(), pt.dmatrix()]


class TapeReversal(RecordOp):
    """Vector-Jacobian product of `TapedLogLikelihood`: inputs, tape and terms_bar -> theta_bar."""

    input_types = (*RECORD_INPUTS, ("tape", "float64", 2), ("terms_bar", "float64", 1))

    def compile(self) -> Compiled:
        """The pass back."""
        return self.filter.compile_reverse(self.system)  # type: ignore[union-attr]

    def results(self) -> list[Variable]:
        """The derivative by theta."""
        return [pt.dvector()]

    def infer_shape(self, node: Apply, input_shapes: Sequence) -> list[tuple]:
        """The shape of theta."""
        return [input_shapes[0]]


@register_specialize
@node_rewriter([LogLikelihoodGradient])
def one_pass_forwards(fgraph: FunctionGraph, node: Apply) -> dict[Variable, Variable] | None:
    """Where value and gradient are wanted at the same inputs, run the filter forwards once."""
    *inputs, terms_bar = node.inputs
    system, filter = node.op.system, node.op.filter
    for value, _ in fgraph.clients[inputs[0]]:
        is_value = value.op in (LogLikelihood(system, filter), TapedLogLikelihood(system, filter))
        if is_value and value.inputs == inputs:
            terms, health, tape = TapedLogLikelihood(system, filter)(*inputs)
            theta_bar = TapeReversal(system, filter)(*inputs, tape, terms_bar)
            return {value.outputs[0]: terms, value.outputs[1]: health, node.outputs[0]: theta_bar}
    return None


@register_funcify_and_cache_key(TapedLogLikelihood)
def _numba_taped(op: TapedLogLikelihood, node: Apply | None = None, **kwargs: Any) -> tuple:
    compiled = kernel(op)
    run = compiled.function
    check, check_rows = check_record(op.system), check_observed(op.system)

    @numba_njit
    def taped_log_likelihood(theta, steps, observed, inputs, t0, seed):
        check(steps, inputs)
        check_rows(steps, observed)
        return run(
            theta.copy(),
            steps.copy(),
            observed.copy(),
            inputs.copy(),
            t0.item(),
            seed.item(),
        )

    return taped_log_likelihood, cache_key(op.system, compiled)


@register_funcify_and_cache_key(TapeReversal)
def _numba_reversal(op: TapeReversal, node: Apply | None = None, **kwargs: Any) -> tuple:
    compiled = kernel(op)
    run = compiled.function

    @numba_njit
    def tape_reversal(theta, steps, observed, inputs, t0, seed, tape, terms_bar):
        # The tape was made by the other operation, which checked the record.
        return run(
            theta.copy(),
            steps.copy(),
            observed.copy(),
            inputs.copy(),
            t0.item(),
            seed.item(),
            tape,
            terms_bar.copy(),
        )

    return tape_reversal, cache_key(op.system, compiled)
