"""Registers how `StateSpaceRV` is drawn, in Python and in numba, and its log-density."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pymc.logprob.abstract import _logprob
from pytensor.graph.basic import Variable
from pytensor.link.numba.dispatch.basic import numba_njit
from pytensor.link.numba.dispatch.random import numba_core_rv_funcify
from pytensor.raise_op import CheckAndRaise
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evaluation.simulate import simulator
from pymc_statespace_filters.ops.base import cache_key, check_record
from pymc_statespace_filters.ops.batch import vectorized
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.pymc_model.random_variable import StateSpaceRV, draw_in_python

_TOO_SHORT = "score_from must be less than the number of observations, of which there are too few"


@draw_in_python.register
def _draw_in_python(op: StateSpaceRV, rng: np.random.Generator, *arguments: Any) -> np.ndarray:
    *params, size = arguments
    theta, steps, inputs, t0, _ = params
    core_ndims = (1, 1, 2, 0, 0)
    batch = np.broadcast_shapes(
        *(np.shape(p)[: np.ndim(p) - n] for p, n in zip(params, core_ndims, strict=True))
    )
    batch = batch if size is None else tuple(size)
    theta, steps, inputs, t0 = (
        np.broadcast_to(p, batch + np.shape(p)[np.ndim(p) - n :])
        for p, n in zip((theta, steps, inputs, t0), core_ndims, strict=False)
    )
    simulate, check = simulator(op.system, True).function, check_record(op.system)
    draws = np.empty((*batch, steps.shape[-1], op.system.p))
    for i in np.ndindex(batch):
        parts = [np.ascontiguousarray(a[i]) for a in (theta, steps, inputs)]
        check(*parts[1:])
        _, draws[i] = simulate(rng, *parts, float(t0[i]))
    return draws


@numba_core_rv_funcify.register(StateSpaceRV)
def _draw_in_numba(op: StateSpaceRV, node: Any) -> tuple:
    compiled = simulator(op.system, True)
    simulate, check = compiled.function, check_record(op.system)
    key = cache_key(op.system, compiled)

    @numba_njit
    def draw(rng, theta, steps, inputs, t0, seed):
        check(steps, inputs)
        _, observations = simulate(rng, theta.copy(), steps.copy(), inputs.copy(), t0)
        return observations

    # PyTensor requires an integer as the cache key of a random variable.
    return draw, None if key is None else int(key[:15], 16)


@_logprob.register(StateSpaceRV)
def _log_density(
    op: StateSpaceRV, values: Sequence, rng: Variable, size: Variable, *params: Any, **kwargs: Any
) -> TensorVariable:
    """log p(d_j | d_1 .. d_{j-1}), one term per observation, 0 for those that are not scored."""
    (value,) = values
    theta, steps, inputs, t0, seed = params
    likelihood = LogLikelihood(op.system, op.filter)
    terms = vectorized(likelihood, theta, steps, value, inputs, t0, seed)[0]
    if op.score_from == 0:
        return terms
    # The length comes from the steps, which do not depend on the parameters as the terms do.
    n_rows = steps.shape[-1]
    rows = CheckAndRaise(ModelError, _TOO_SHORT)(pt.arange(n_rows), pt.gt(n_rows, op.score_from))
    return pt.switch(pt.ge(rows, op.score_from), terms, 0.0)
