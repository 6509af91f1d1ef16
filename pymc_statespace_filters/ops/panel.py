"""The log-likelihood of a panel, all records of one table, as single operations.

Theta has a row for each record, and ``rows`` (J, 3), see `system.panel`, take the place of the
steps. A record is evaluated by the machine code of a single one, so that it has the same bits,
unless the filter evaluates records side by side (`filters.protocol.PanelFilter`).
"""

from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.fg import FunctionGraph
from pytensor.graph.replace import _vectorize_node
from pytensor.graph.rewriting.basic import node_rewriter
from pytensor.tensor.blockwise import Blockwise
from pytensor.tensor.rewriting.basic import register_specialize

from ..compiler.codegen.function_types import CompiledFunction, jit
from ..compiler.lowering.compiled_system import CompiledSystem
from ..compiler.native.cache_key import key_of
from ..compiler.native.planned_function import PlannedFunction
from ..compiler.numerics.record_noise import seed_of_record
from ..filters.outcomes import NONE
from ..filters.protocol import Compiled, PanelFilter
from ..filters.records import end_of_record, include_health, single_record
from ..system.panel import RECORD
from .base import RECORD_INPUTS
from .likelihood import (
    LogLikelihood,
    LogLikelihoodGradient,
    TapedLogLikelihood,
    TapePullback,
    fused,
)

PANEL_INPUTS = (("theta", "float64", 2), ("steps", "int64", 2), *RECORD_INPUTS[2:])
_CHECKS = ("check_panel(theta, steps, inputs)", "check_observed(steps, observed)")


class PanelLogLikelihood(LogLikelihood):
    """`LogLikelihood` of a panel: theta (G, k), rows (J, 3) -> terms (J,), health (3,).

    Health is that of the whole panel: the smallest effective number of particles, and code and row
    of the first failing record. A record that fails has terms of -inf, the others keep theirs.
    """

    input_types = PANEL_INPUTS
    record_checks = _CHECKS
    gufunc_signature = "(g,k),(j,c),(j,p),(s,u),(),()->(j),(h)"

    def compile(self, system: CompiledSystem) -> Compiled:
        """All records side by side if the filter has that, else one after the other."""
        if isinstance(self.filter, PanelFilter):
            return self.filter.compile_panel(system)
        compiled = self.filter.compile(system)
        return compiled if isinstance(compiled, PlannedFunction) else _one_by_one(compiled)

    def gradient(self) -> "PanelLogLikelihoodGradient":
        """The operation of the vector-Jacobian product."""
        return PanelLogLikelihoodGradient(self.system, self.filter)


class PanelLogLikelihoodGradient(LogLikelihoodGradient):
    """Vector-Jacobian product of `PanelLogLikelihood`: terms_bar (J,) -> theta_bar (G, k)."""

    input_types = (*PANEL_INPUTS, ("terms_bar", "float64", 1))
    output_types = (pt.dmatrix,)
    record_checks = _CHECKS
    gufunc_signature = "(g,k),(j,c),(j,p),(s,u),(),(),(j)->(g,k)"

    def compile(self, system: CompiledSystem) -> Compiled:
        """Both passes of the filter."""
        if isinstance(self.filter, PanelFilter):
            return self.filter.compile_panel_gradient(system)
        compiled = self.filter.compile_gradient(system)
        return (
            compiled if isinstance(compiled, PlannedFunction) else _gradients_one_by_one(compiled)
        )


class TapedPanelLogLikelihood(TapedLogLikelihood):
    """`PanelLogLikelihood` with a third output, the filter's tape."""

    input_types = PANEL_INPUTS
    record_checks = _CHECKS
    filter: Any

    def compile(self, system: CompiledSystem) -> Compiled:
        """The forward pass."""
        return self.filter.compile_panel_taped(system)


class PanelTapePullback(TapePullback):
    """Vector-Jacobian product of `TapedPanelLogLikelihood`."""

    input_types = (*PANEL_INPUTS, ("tape", "float64", 2), ("terms_bar", "float64", 1))
    output_types = (pt.dmatrix,)
    filter: Any

    def compile(self, system: CompiledSystem) -> Compiled:
        """The backward pass."""
        return self.filter.compile_panel_pullback(system)


@register_specialize
@node_rewriter([PanelLogLikelihoodGradient])
def fuse_value_and_gradient_of_panel(
    fgraph: FunctionGraph, node: Apply
) -> dict[Variable, Variable] | None:
    """Make one forward pass where a graph holds value and gradient at the same inputs."""
    if not isinstance(node.op.filter, PanelFilter):
        return None
    return fused(fgraph, node, PanelLogLikelihood, TapedPanelLogLikelihood, PanelTapePullback)


@_vectorize_node.register(PanelLogLikelihood)
def _vectorize(op: PanelLogLikelihood, node: Apply, *inputs: Variable) -> list[Variable]:
    return Blockwise(op)(*inputs, return_list=True)


def _one_by_one(value: CompiledFunction) -> CompiledFunction:
    run = value.function

    def panel(theta, rows, observed, inputs, t0, noise):
        seed, normals = noise
        terms = np.empty(rows.shape[0])
        health = np.array([np.inf, float(NONE), -1.0])
        first = 0
        for record in range(theta.shape[0]):
            last = end_of_record(rows, first)
            terms[first:last], of_record = run(
                *single_record(theta, rows, observed, inputs, record, first, last),
                t0,
                (seed_of_record(seed, rows[first, RECORD]), normals),
            )
            include_health(health, of_record, first)
            first = last
        return terms, health

    return CompiledFunction(
        jit(panel, value.large), key_of(__name__, "panel", value.key), value.large
    )


def _gradients_one_by_one(gradient: CompiledFunction) -> CompiledFunction:
    run = gradient.function

    def panel(theta, rows, observed, inputs, t0, seed, terms_bar):
        theta_bar = np.empty(theta.shape)
        first = 0
        for record in range(theta.shape[0]):
            last = end_of_record(rows, first)
            theta_bar[record] = run(
                *single_record(theta, rows, observed, inputs, record, first, last),
                t0,
                seed,
                terms_bar[first:last],
            )
            first = last
        return theta_bar

    key = key_of(__name__, "gradient of a panel", gradient.key)
    return CompiledFunction(jit(panel, gradient.large), key, gradient.large)
