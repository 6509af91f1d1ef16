"""The operation behind `StateSpace`: how records are drawn, and what their log-density is."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pymc.logprob.abstract import _logprob
from pytensor.graph.basic import Variable
from pytensor.link.numba.dispatch.basic import numba_njit
from pytensor.link.numba.dispatch.random import numba_core_rv_funcify
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.evaluation.simulate import simulator
from pymc_statespace_filters.filters.protocol import Filter
from pymc_statespace_filters.ops.base import cache_key, check_record
from pymc_statespace_filters.ops.batch import vectorized
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.system.model import StateSpaceModel


class StateSpaceRV(RandomVariable):
    """Draws a record (J, p): parameters theta, steps, inputs, t0 and the (unused) noise seed."""

    name = "StateSpace"
    signature = "(k),(j),(s,u),(),()->(j,p)"
    dtype = "float64"
    __props__ = (*RandomVariable.__props__, "system", "filter")
    _print_name = ("StateSpace", "\\operatorname{StateSpace}")

    def __init__(self, *, system: StateSpaceModel, filter: Filter, **settings: Any) -> None:
        self.system = system
        self.filter = filter
        super().__init__(**settings)

    def __str__(self) -> str:
        return f"StateSpaceRV{{{self.filter}}}"

    def _supp_shape_from_params(self, dist_params: Sequence, param_shapes: Any = None) -> list:
        steps = dist_params[1].shape if param_shapes is None else param_shapes[1]
        return [steps[-1], self.system.p]

    def rng_fn(self, rng: np.random.Generator, *arguments: Any) -> np.ndarray:
        """Draw in Python, where the default numba mode is not used."""
        *params, size = arguments
        theta, steps, inputs, t0, _ = params
        cores = (1, 1, 2, 0, 0)
        batch = np.broadcast_shapes(
            *(np.shape(p)[: np.ndim(p) - n] for p, n in zip(params, cores, strict=True))
        )
        batch = batch if size is None else tuple(size)
        theta, steps, inputs, t0 = (
            np.broadcast_to(p, batch + np.shape(p)[np.ndim(p) - n :])
            for p, n in zip((theta, steps, inputs, t0), cores, strict=False)
        )
        simulate, check = simulator(self.system).function, check_record(self.system)
        draws = np.empty((*batch, steps.shape[-1], self.system.p))
        for i in np.ndindex(batch):
            parts = [np.ascontiguousarray(a[i]) for a in (theta, steps, inputs)]
            check(*parts[1:])
            _, draws[i] = simulate(rng, *parts, float(t0[i]))
        return draws


@numba_core_rv_funcify.register(StateSpaceRV)
def _numba_draw(op: StateSpaceRV, node: Any) -> tuple:
    compiled = simulator(op.system)
    simulate, check = compiled.function, check_record(op.system)
    key = cache_key(op.system, compiled)

    @numba_njit
    def draw(rng, theta, steps, inputs, t0, seed):
        check(steps, inputs)
        _, observations = simulate(
            rng,
            theta.copy(),
            steps.copy(),
            inputs.copy(),
            t0,
        )
        return observations

    # PyTensor asks for a whole number here.
    return draw, None if key is None else int(key[:15], 16)


@_logprob.register(StateSpaceRV)
def _log_density(
    op: StateSpaceRV, values: Sequence, rng: Variable, size: Variable, *params: Any, **kwargs: Any
) -> TensorVariable:
    """log p(d_j | d_1 .. d_{j-1}), one term per observation."""
    (value,) = values
    theta, steps, inputs, t0, seed = params
    likelihood = LogLikelihood(op.system, op.filter)
    arguments = (theta, steps, value, inputs, t0, seed)
    cores = (1, 1, 2, 2, 0, 0)
    batched = any(a.type.ndim > n for a, n in zip(arguments, cores, strict=True))
    return (vectorized(likelihood, *arguments) if batched else likelihood(*arguments))[0]
