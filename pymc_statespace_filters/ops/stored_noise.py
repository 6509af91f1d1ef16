"""The log-likelihood of an estimating filter as a function of its normals instead of their seed.

Reading a normal is many times cheaper than making it. Whoever evaluates again and again on the same
noise (common random numbers), or moves it a little at a time, makes the normals once.
"""

from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.basic import Apply, Variable
from pytensor.link.numba.dispatch.basic import numba_njit, register_funcify_and_cache_key

from pymc_statespace_filters.lowering import Compiled
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.ops.record import (
    RECORD_INPUTS,
    RecordOp,
    cache_key,
    check_observed,
    check_record,
    kernel,
)


class StoredNoise(RecordOp):
    """The normals that a noisy filter uses with a seed: ``steps`` (J,), ``seed`` -> a vector."""

    input_types = (RECORD_INPUTS[1], RECORD_INPUTS[5])

    def compile(self) -> Compiled:
        """The filter's own layout of its normals."""
        return self.filter.stored_noise(self.system)  # type: ignore[union-attr]

    def results(self) -> list[Variable]:
        """One vector."""
        return [pt.dvector()]


class LogLikelihoodOfNoise(LogLikelihood):
    """`LogLikelihood` with the vector of `StoredNoise` in place of the seed; the same numbers."""

    input_types = (*RECORD_INPUTS[:5], ("normals", "float64", 1))
    gufunc_signature = "(k),(j),(j,p),(s,u),(),(z)->(j),(h)"


@register_funcify_and_cache_key(StoredNoise)
def _numba_stored_noise(op: StoredNoise, node: Apply | None = None, **kwargs: Any) -> tuple:
    compiled = kernel(op)
    store = compiled.function

    @numba_njit
    def stored_noise(steps, seed):
        return store(steps.copy(), seed.item())

    return stored_noise, compiled.key


@register_funcify_and_cache_key(LogLikelihoodOfNoise)
def _numba_of_noise(op: LogLikelihoodOfNoise, node: Apply | None = None, **kwargs: Any) -> tuple:
    compiled = kernel(op)
    run = compiled.function
    check, check_rows = check_record(op.system), check_observed(op.system)

    @numba_njit
    def log_likelihood(theta, steps, observed, inputs, t0, normals):
        check(steps, inputs)
        check_rows(steps, observed)
        return run(
            theta.copy(),
            steps.copy(),
            observed.copy(),
            inputs.copy(),
            t0.item(),
            (np.int64(0), np.ascontiguousarray(normals)),
        )

    return log_likelihood, cache_key(op.system, compiled)
