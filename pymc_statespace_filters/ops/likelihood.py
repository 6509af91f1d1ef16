"""The log-likelihood of a record and its gradient as PyTensor operations.

A graph may hold `LogLikelihood` or `LogLikelihoodGradient` alone. Where it holds both at the same
inputs, a rewrite replaces them by one forward pass that leaves a tape, `TapedLogLikelihood`, and
one backward pass over it, `TapePullback`.
"""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import pytensor.tensor as pt
from pytensor.gradient import DisconnectedType
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.fg import FunctionGraph
from pytensor.graph.rewriting.basic import node_rewriter
from pytensor.tensor.rewriting.basic import register_specialize

from ..compiler.lowering.compiled_system import CompiledSystem, compile_system
from ..errors import GradientUnavailableError
from ..filters.protocol import Compiled, DifferentiableFilter
from ..filters.recommendation import filters_for, listed, short_form
from .base import HEALTH_SIZE, RECORD_INPUTS, FilterOp, ThetaDerivative, theta_cotangent_only


class LogLikelihood(FilterOp):
    """log p(d_j | d_1 .. d_{j-1}) of every observation, and a record of the filter's health.

    Inputs: ``theta`` (k,), ``steps`` (J,), ``observed`` (J, p), ``inputs`` (steps, n_inputs),
    ``t0``, ``seed``. Outputs: terms (J,), and health (3,): smallest effective number of
    particles, code of the failure, index of the failing observation.
    """

    output_types = (pt.dvector, pt.dvector)
    gufunc_signature = "(k),(j),(j,p),(s,u),(),()->(j),(h)"
    argument_code: ClassVar[Mapping[str, str | None]] = {"seed": "(seed.item(), no_normals.copy())"}

    def compile(self, system: CompiledSystem) -> Compiled:
        """The filter's log-likelihood."""
        return self.filter.compile(system)

    def infer_shape(self, node: Apply, input_shapes: Sequence) -> list[tuple]:
        """As many terms as steps."""
        return [(input_shapes[1][0],), (HEALTH_SIZE,)]

    def pullback(
        self,
        inputs: Sequence[Variable],
        outputs: Sequence[Variable],
        cotangents: Sequence[Variable],
    ) -> list[Variable]:
        """Reverse-mode derivative by theta; raises for a filter whose likelihood has none."""
        check_has_gradient(self)
        terms_bar = cotangents[0]
        if isinstance(terms_bar.type, DisconnectedType):
            theta_bar = pt.zeros_like(inputs[0])
        else:
            theta_bar = self.gradient()(*inputs, terms_bar)
        return theta_cotangent_only(self, inputs, theta_bar)

    def gradient(self) -> "LogLikelihoodGradient":
        """The operation of the vector-Jacobian product."""
        return LogLikelihoodGradient(self.system, self.filter)


def check_has_gradient(op: LogLikelihood) -> None:
    """Raise, and name samplers that need none, unless the likelihood has a gradient."""
    if op.filter.has_gradient:
        return
    what = "is a random estimate without a" if op.filter.noisy else "does not come with a"
    with_gradient = listed(f for f in filters_for(compile_system(op.system)) if f.has_gradient)
    remedy = f", or take a filter with a gradient: {with_gradient}" if with_gradient else ""
    raise GradientUnavailableError(
        f"The likelihood by {short_form(op.filter)} {what} gradient, so NUTS, HMC, "
        f"nutpie and find_MAP cannot use it. Sample with psf.sample_dram() or "
        f"pm.sample(step=psf.DRAM()){remedy}."
    )


class LogLikelihoodGradient(ThetaDerivative):
    """Vector-Jacobian product of `LogLikelihood`: inputs and terms_bar (J,) -> theta_bar (k,).

    It makes both passes of the filter. In a graph that holds the likelihood too, the forward pass
    is made only once: see `fuse_value_and_gradient`.
    """

    input_types = (*RECORD_INPUTS, ("terms_bar", "float64", 1))
    gufunc_signature = "(k),(j),(j,p),(s,u),(),(),(j)->(k)"
    filter: DifferentiableFilter

    def compile(self, system: CompiledSystem) -> Compiled:
        """Both passes of the filter."""
        return self.filter.compile_gradient(system)


class TapedLogLikelihood(FilterOp):
    """`LogLikelihood` with a third output, the tape: a state of the filter in each row."""

    filter: DifferentiableFilter
    output_types = (pt.dvector, pt.dvector, pt.dmatrix)
    result_names = ("terms", "health", "tape")

    def compile(self, system: CompiledSystem) -> Compiled:
        """The forward pass."""
        return self.filter.compile_taped(system)


class TapePullback(ThetaDerivative):
    """Vector-Jacobian product of `TapedLogLikelihood`: inputs, tape and terms_bar -> theta_bar."""

    filter: DifferentiableFilter
    input_types = (*RECORD_INPUTS, ("tape", "float64", 2), ("terms_bar", "float64", 1))
    # The tape was made by the other operation, which checked the record.
    record_checks = ()
    argument_code: ClassVar[Mapping[str, str | None]] = {"tape": "tape"}

    def compile(self, system: CompiledSystem) -> Compiled:
        """The backward pass."""
        return self.filter.compile_pullback(system)


@register_specialize
@node_rewriter([LogLikelihoodGradient])
def fuse_value_and_gradient(fgraph: FunctionGraph, node: Apply) -> dict[Variable, Variable] | None:
    """Make one forward pass where a graph holds value and gradient at the same inputs."""
    return fused(fgraph, node, LogLikelihood, TapedLogLikelihood, TapePullback)


def fused(
    fgraph: FunctionGraph,
    node: Apply,
    value_op: type[LogLikelihood],
    taped_op: type[TapedLogLikelihood],
    pullback_op: type[TapePullback],
) -> dict[Variable, Variable] | None:
    """Replacements of a gradient and of the value at the same inputs, if there is one."""
    *inputs, terms_bar = node.inputs
    system, filter = node.op.system, node.op.filter
    for value, _ in fgraph.clients[inputs[0]]:
        is_value = value.op in (value_op(system, filter), taped_op(system, filter))
        if is_value and value.inputs == inputs:
            terms, health, tape = taped_op(system, filter)(*inputs)
            theta_bar = pullback_op(system, filter)(*inputs, tape, terms_bar)
            return {value.outputs[0]: terms, value.outputs[1]: health, node.outputs[0]: theta_bar}
    return None
