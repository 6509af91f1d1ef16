"""The derivative of a log-likelihood as a PyTensor operation."""

from collections.abc import Sequence
from typing import Any

import pytensor.tensor as pt
from pytensor.graph.basic import Apply, Variable
from pytensor.link.numba.dispatch.basic import numba_njit, register_funcify_and_cache_key

from pymc_statespace_filters.lowering import Compiled
from pymc_statespace_filters.ops.record import (
    RECORD_INPUTS,
    RecordOp,
    cache_key,
    check_observed,
    check_record,
    kernel,
)


class LogLikelihoodGradient(RecordOp):
    """Vector-Jacobian product of `LogLikelihood`: inputs and terms_bar (J,) -> theta_bar (k,).

    It runs the filter forwards and then backwards. A graph that holds the likelihood as well needs
    the first only once: see `tape`.
    """

    input_types = (*RECORD_INPUTS, ("terms_bar", "float64", 1))
    gufunc_signature = "(k),(j),(j,p),(s,u),(),(),(j)->(k)"

    def compile(self) -> Compiled:
        """Both passes of the filter."""
        return self.filter.compile_gradient(self.system)  # type: ignore[union-attr]

    def results(self) -> list[Variable]:
        """The derivative by theta."""
        return [pt.dvector()]

    def infer_shape(self, node: Apply, input_shapes: Sequence) -> list[tuple]:
        """The shape of theta."""
        return [input_shapes[0]]


@register_funcify_and_cache_key(LogLikelihoodGradient)
def _numba_gradient(op: LogLikelihoodGradient, node: Apply | None = None, **kwargs: Any) -> tuple:
    compiled = kernel(op)
    run = compiled.function
    check, check_rows = check_record(op.system), check_observed(op.system)

    @numba_njit
    def log_likelihood_gradient(theta, steps, observed, inputs, t0, seed, terms_bar):
        check(steps, inputs)
        check_rows(steps, observed)
        return run(
            theta.copy(),
            steps.copy(),
            observed.copy(),
            inputs.copy(),
            t0.item(),
            seed.item(),
            terms_bar.copy(),
        )

    return log_likelihood_gradient, cache_key(op.system, compiled)
