"""Value and gradient together: one pass forwards that leaves a tape, and one pass back over it.

`LogLikelihood` and `LogLikelihoodGradient` stand for themselves, so that a graph may hold either
alone. Where one graph holds both at the same inputs, a rewrite puts the two operations
of this file in their place.
"""

from collections.abc import Mapping
from typing import ClassVar

import pytensor.tensor as pt
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.fg import FunctionGraph
from pytensor.graph.rewriting.basic import node_rewriter
from pytensor.tensor.rewriting.basic import register_specialize

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction
from pymc_statespace_filters.ops.base import RECORD_INPUTS, FilterOp, ThetaDerivative
from pymc_statespace_filters.ops.gradient import LogLikelihoodGradient
from pymc_statespace_filters.ops.likelihood import LogLikelihood


class TapedLogLikelihood(FilterOp):
    """`LogLikelihood` with a third output, the tape: a state of the filter in each row."""

    def compile(self) -> CompiledFunction:
        """The pass forwards."""
        return self.filter.compile_taped(self.system)  # type: ignore[union-attr]

    def results(self) -> list[Variable]:
        """Terms, health and tape."""
        return [pt.dvector(), pt.dvector(), pt.dmatrix()]


class TapePullback(ThetaDerivative):
    """Vector-Jacobian product of `TapedLogLikelihood`: inputs, tape and terms_bar -> theta_bar."""

    input_types = (*RECORD_INPUTS, ("tape", "float64", 2), ("terms_bar", "float64", 1))
    # The tape was made by the other operation, which checked the record.
    checks_record = False
    argument_code: ClassVar[Mapping[str, str]] = {"tape": "tape"}

    def compile(self) -> CompiledFunction:
        """The pass back."""
        return self.filter.compile_reverse(self.system)  # type: ignore[union-attr]


@register_specialize
@node_rewriter([LogLikelihoodGradient])
def fuse_value_and_gradient(fgraph: FunctionGraph, node: Apply) -> dict[Variable, Variable] | None:
    """Where value and gradient are wanted at the same inputs, run the filter forwards once."""
    *inputs, terms_bar = node.inputs
    system, filter = node.op.system, node.op.filter
    for value, _ in fgraph.clients[inputs[0]]:
        is_value = value.op in (LogLikelihood(system, filter), TapedLogLikelihood(system, filter))
        if is_value and value.inputs == inputs:
            terms, health, tape = TapedLogLikelihood(system, filter)(*inputs)
            theta_bar = TapePullback(system, filter)(*inputs, tape, terms_bar)
            return {value.outputs[0]: terms, value.outputs[1]: health, node.outputs[0]: theta_bar}
    return None
