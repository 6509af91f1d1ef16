"""Log-likelihoods and their gradients as PyTensor operations: of a record, of points, of a panel.

A graph may hold `LogLikelihood` or `LogLikelihoodGradient` alone. Where it holds both at the same
inputs, a rewrite replaces them by one forward pass that leaves a tape, `TapedLogLikelihood`, and
one backward pass over it, `TapePullback`.

A record of a panel is evaluated by the machine code of a single one, so that it has the same bits,
unless the filter evaluates records side by side (`filters.protocol.DifferentiableFilter`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import pytensor.tensor as pt
from pytensor.gradient import DisconnectedType
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.fg import FunctionGraph
from pytensor.graph.replace import _vectorize_node
from pytensor.graph.rewriting.basic import node_rewriter
from pytensor.tensor.blockwise import Blockwise
from pytensor.tensor.rewriting.basic import register_specialize

from ..compiler.lowering.compiled_system import CompiledSystem, compile_system
from ..compiler.native.plan import Plan
from ..errors import GradientUnavailableError
from ..facts import Fact, in_words
from ..filters.protocol import DifferentiableFilter, EnsembleFilter
from ..filters.written import short_form
from .base import HEALTH_SIZE, FilterOp, theta_cotangent_only
from .signatures import (
    GRADIENT,
    LIKELIHOOD,
    NORMALS,
    ONE_RECORD,
    PANEL,
    POINTS,
    PULLBACK,
    RECORD,
    TAPED,
    Signature,
)


class LogLikelihood(FilterOp):
    """log p(d_j | d_1 .. d_{j-1}) of every observation, and a record of the filter's health.

    Inputs: ``theta`` (k,), ``steps`` (J,), ``observed`` (J, p), ``inputs`` (steps, n_inputs),
    ``t0``, ``seed``. Outputs: terms (J,), and health (3,): smallest effective number of
    particles, code of the failure, index of the failing observation. See `ops.signatures` for
    those of many points and of a panel.
    """

    signature = LIKELIHOOD

    def plan(self, system: CompiledSystem) -> Plan:
        """The filter's log-likelihood."""
        if self.form != ONE_RECORD and isinstance(self.filter, DifferentiableFilter):
            return self.filter.plan_of_pass(system, of_many=True)
        return self.filter.plan_of_likelihood(system)

    def infer_shape(self, node: Apply, input_shapes: Sequence) -> list[tuple]:
        """As many terms as steps, for every point."""
        points = (input_shapes[0][0],) if self.form == POINTS else ()
        return [(*points, input_shapes[1][0]), (*points, HEALTH_SIZE)]

    def pullback(
        self,
        inputs: Sequence[Variable],
        outputs: Sequence[Variable],
        cotangents: Sequence[Variable],
    ) -> list[Variable]:
        """Reverse-mode derivative by theta; raises for a filter whose likelihood has none."""
        check_has_gradient(self)
        theta_bar = pt.zeros_like(inputs[0])
        if not isinstance(cotangents[0].type, DisconnectedType):
            theta_bar = self.gradient()(*inputs, cotangents[0])
        return theta_cotangent_only(self, inputs, theta_bar)

    def gradient(self) -> FilterOp | Blockwise:
        """The operation of the vector-Jacobian product; point by point for many points."""
        if self.form == POINTS:
            return Blockwise(LogLikelihoodGradient(self.system, self.filter))
        return LogLikelihoodGradient(self.system, self.filter, self.form)


@dataclass(frozen=True)
class NoGradient(Fact):
    """A likelihood has no gradient; in words, which filters of the system have one."""

    system: CompiledSystem


def check_has_gradient(op: LogLikelihood) -> None:
    """Raise, and name samplers that need none, unless the likelihood has a gradient."""
    if op.filter.has_gradient:
        return
    what = "is a random estimate without a" if op.filter.noisy else "does not come with a"
    remedy = in_words(NoGradient(compile_system(op.system)))
    raise GradientUnavailableError(
        f"The likelihood by {short_form(op.filter)} {what} gradient, so NUTS, HMC, "
        f"nutpie and find_MAP cannot use it. Sample with psf.sample_dram() or "
        f"pm.sample(step=psf.DRAM()){f', or {remedy}' if remedy else ''}."
    )


class LogLikelihoodGradient(FilterOp):
    """Vector-Jacobian product of `LogLikelihood`: its inputs, and the cotangent of the terms.

    It makes both passes of the filter. In a graph that holds the likelihood too, the forward pass
    is made only once: see `fuse_value_and_gradient`.
    """

    signature = GRADIENT
    filter: DifferentiableFilter

    def plan(self, system: CompiledSystem) -> Plan:
        """Both passes of the filter."""
        many = self.form == PANEL
        return self.filter.plan_of_pass(system, of_many=many, leaves_tape=True, goes_back=True)

    def infer_shape(self, node: Apply, input_shapes: Sequence) -> list[tuple]:
        """The shape of theta."""
        return [input_shapes[0]]


class TapedLogLikelihood(FilterOp):
    """`LogLikelihood` with a third output, the tape: a state of the filter in each row."""

    signature = TAPED
    filter: DifferentiableFilter

    def plan(self, system: CompiledSystem) -> Plan:
        """The forward pass."""
        return self.filter.plan_of_pass(system, of_many=self.form == PANEL, leaves_tape=True)


class TapePullback(FilterOp):
    """Vector-Jacobian product of `TapedLogLikelihood`: inputs, tape and the terms' cotangent."""

    signature = PULLBACK
    filter: DifferentiableFilter
    infer_shape = LogLikelihoodGradient.infer_shape

    def plan(self, system: CompiledSystem) -> Plan:
        """The backward pass."""
        return self.filter.plan_of_pass(system, of_many=self.form == PANEL, goes_back=True)


@register_specialize
@node_rewriter([LogLikelihoodGradient])
def fuse_value_and_gradient(fgraph: FunctionGraph, node: Apply) -> dict[Variable, Variable] | None:
    """Make one forward pass where a graph holds value and gradient at the same inputs."""
    op = node.op
    *inputs, terms_bar = node.inputs
    value_op, taped, pullback = (
        kind(op.system, op.filter, op.form)
        for kind in (LogLikelihood, TapedLogLikelihood, TapePullback)
    )
    for value, _ in fgraph.clients[inputs[0]]:
        if value.op in (value_op, taped) and value.inputs == inputs:
            terms, health, tape = taped(*inputs)
            theta_bar = pullback(*inputs, tape, terms_bar)
            return {value.outputs[0]: terms, value.outputs[1]: health, node.outputs[0]: theta_bar}
    return None


def vectorized(op: LogLikelihood, *inputs: Variable) -> list[Variable]:
    """Terms and health over leading dimensions, of the parameters alone or of any input."""
    extra = [v.type.ndim - ndim for v, (_, ndim) in zip(inputs, op.arguments, strict=True)]
    if not any(extra):
        return op(*inputs, return_list=True)
    theta, *record = inputs
    one_record = max(extra[1:]) <= extra[0] and all(
        length == 1
        for value, n in zip(record, extra[1:], strict=True)
        for length in value.type.shape[:n]
    )
    is_batch = op.form == ONE_RECORD and isinstance(op.filter, DifferentiableFilter)
    if not (is_batch and one_record and extra[0]):
        return Blockwise(op)(*inputs, return_list=True)
    record = [value[(0,) * n] if n else value for value, n in zip(record, extra[1:], strict=True)]
    shape = tuple(theta.shape)[:-1]
    batch = LogLikelihood(op.system, op.filter, POINTS)
    if len(shape) == 1:
        return batch(theta, *record)
    points = theta.reshape((pt.prod(pt.stack(shape)), theta.shape[-1]))
    results = batch(points, *record)
    return [result.reshape((*shape, result.shape[-1])) for result in results]


@_vectorize_node.register(LogLikelihood)
def _vectorize(op: LogLikelihood, node: Apply, *inputs: Variable) -> list[Variable]:
    return vectorized(op, *inputs)


class StoredNoise(FilterOp):
    """The normals that a noisy filter uses with a seed: ``steps`` (J,), ``seed`` -> a vector.

    Reading a normal is many times cheaper than drawing it. A sampler that holds the noise (common
    random numbers), or moves it a little at a time, draws the normals once.
    """

    signature = NORMALS
    filter: EnsembleFilter

    def plan(self, system: CompiledSystem) -> Plan:
        """The normals, in the filter's layout."""
        return self.filter.plan_of_noise(system)


class LogLikelihoodOfNoise(LogLikelihood):
    """`LogLikelihood` with the vector of `StoredNoise` in place of the seed; the same numbers."""

    signature = Signature((*RECORD, ("normals", 1)), LIKELIHOOD.results)
