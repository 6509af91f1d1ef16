"""What a system of one state gives to a filter of densities: the law of a step, and of a datum."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import pytensor.scalar as ps
import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.codegen.function_types import Graph, VectorFunction
from pymc_statespace_filters.compiler.codegen.functions import (
    member_function,
    unrolled,
    vector_functions,
)
from pymc_statespace_filters.compiler.codegen.scalarize import NotUnrollableError
from pymc_statespace_filters.compiler.codegen.source import depends_on
from pymc_statespace_filters.compiler.lowering.ensemble import covariance_check
from pymc_statespace_filters.compiler.lowering.gaussian import log_normal, without_missing
from pymc_statespace_filters.compiler.lowering.structure import is_free_of
from pymc_statespace_filters.compiler.lowering.symbols import (
    call,
    jacobian_of,
    observation_moments,
    symbols_of,
)
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.system.model import StateSpaceModel

_KINKED = (
    ps.Switch, ps.Abs, ps.ScalarMaximum, ps.ScalarMinimum, ps.Clip, ps.Sign, ps.Floor, ps.Ceil,
    ps.Mod, ps.IntDiv, ps.Cast,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class OneState:
    """Compiled functions of a system of one state whose noise is Gaussian given the state.

    Points are columns: ``X`` (1, N). ``k`` is the step, ``t`` its time.

    * ``start(theta)`` gives (mean, variance) of the state at step 0.
    * ``move(theta, inputs, k, t, X, M)`` writes the mean and the variance of the state one step
      later, given each point, into M (2, N).
    * ``log_density(theta, inputs, k, t, d, X, out)`` writes log p(d | x), NaN components left out.
    * ``valid(theta)`` tells whether every covariance is non-negative.
    * ``same_every_step`` tells that ``move`` depends on neither inputs nor time.
    """

    n_theta: int
    p: int
    n_inputs: int
    dt: float
    same_every_step: bool
    start: Any
    move: Any
    log_density: Any
    valid: Any
    key: str | None


@lru_cache(maxsize=256)
def has_additive_process_noise(system: StateSpaceModel) -> bool:
    """Whether g(x, q) = g(x, 0) + G(x) q; False too where that cannot be seen."""
    symbols = symbols_of(system)
    transition = call(system.equations.transition, system, symbols)
    return is_free_of(("q",), jacobian_of(transition, symbols["q"]), symbols)


@lru_cache(maxsize=256)
def has_smooth_transition(system: StateSpaceModel) -> bool:
    """Whether no part of the transition has a kink or a jump; False where that cannot be seen."""
    symbols = symbols_of(system)
    transition = call(system.equations.transition, system, symbols)
    try:
        (values,) = unrolled(Graph(symbols, [transition]))
    except NotUnrollableError:
        return False
    return not any(isinstance(e.op, _KINKED) for e in depends_on(values, frozenset({"x.0"})))


@lru_cache(maxsize=256)
def one_state(system: StateSpaceModel) -> OneState:
    """Compile what a filter of densities needs of a system with one state and additive noise."""
    symbols = {name: symbols_of(system)[name] for name in ("theta", *"xutd")}
    theta = {"theta": symbols["theta"]}
    start = pt.concatenate(
        [
            call(system.equations.initial_mean, system, theta),
            call(system.equations.initial_cov, system, theta).ravel(),
        ]
    )
    step = {name: symbols[name] for name in ("theta", *"xut")}
    moments = _step_moments(system, step)
    density = pt.atleast_1d(_log_density(system, symbols))
    start_function = VectorFunction("c", Graph(theta, [start]))
    parts = {
        "start": vector_functions({"start": start_function})["start"],
        "move": member_function(
            "move", "c, inputs, k, t, X, M", Graph(step, [moments]), "M[{i}, member]"
        ),
        "log_density": member_function(
            "log_density", "c, inputs, k, t, d, X, out", Graph(symbols, [density]), "out[member]"
        ),
        "valid": covariance_check(system),
    }
    same_every_step = is_free_of(("u", "t"), moments, step)
    keys = [part.key for part in parts.values()]
    sizes = (system.n_theta, system.p, system.n_inputs)
    return OneState(
        *sizes,
        dt=system.dt,
        same_every_step=same_every_step,
        **{name: part.function for name, part in parts.items()},
        key=key_of(repr((sizes, system.dt, same_every_step)), *keys),
    )


def _step_moments(system: StateSpaceModel, symbols: dict[str, TensorVariable]) -> TensorVariable:
    """(g(x, 0), G Q G^T)."""
    q = pt.zeros((system.m,))
    mean = call(system.equations.transition, system, {**symbols, "q": q})
    gain = jacobian_of(mean, q)
    cov = pt.eye(system.m)
    if system.equations.process_noise is not None:
        cov = call(system.equations.process_noise, system, symbols)
    return pt.specify_shape(pt.concatenate([mean, (gain @ cov @ gain.T).ravel()]), (2,))


def _log_density(system: StateSpaceModel, symbols: dict[str, TensorVariable]) -> TensorVariable:
    """log p(d | x); Gaussian noise through D Gamma D^T at e = 0 (Eqs. 4.4, 4.12)."""
    if system.equations.observation_logp is not None:
        return call(system.equations.observation_logp, system, symbols)
    mean, cov = observation_moments(system, symbols)
    return log_normal(*without_missing(symbols["d"], mean, cov))
