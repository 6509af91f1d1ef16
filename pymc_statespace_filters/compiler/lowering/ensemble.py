"""What a system gives to the filters that move many members: compiled, member by member."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pytensor.tensor as pt
from numba import carray, types
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.codegen.function_types import (
    CompiledFunction,
    Graph,
    VectorFunction,
    jit,
)
from pymc_statespace_filters.compiler.codegen.functions import member_function, vector_functions
from pymc_statespace_filters.compiler.lowering.gaussian import log_normal, without_missing
from pymc_statespace_filters.compiler.lowering.structure import merged_noise
from pymc_statespace_filters.compiler.lowering.symbols import call, observation_moments, symbols_of
from pymc_statespace_filters.compiler.native.cache_key import digest, key_of
from pymc_statespace_filters.compiler.native.entry_point import F64_PTR, EntryPoint
from pymc_statespace_filters.system.model import StateSpaceModel


@dataclass(frozen=True, eq=False)
class Machine:
    """Compiled functions of one system on ensembles ``X`` of shape (states, members).

    ``c`` are the constants of one evaluation, ``c = prepare(theta)``; ``Z`` holds standard normals
    and may have more columns than there are members; ``k`` is the step, ``t`` its time.

    ``m`` is the number of normals that one step of a member takes: see `merged_noise`.

    * ``initialise(c, Z, X)`` draws the state at step 0.
    * ``propagate(c, inputs, k, t, Z, X)`` moves every member from step k to k + 1, in place.
    * ``observe(c, inputs, k, t, Z, X, D)`` writes simulated observations (observables, members),
      for Kalman updates; None where the density of an observation is not this function's.
    * ``simulate`` is the same wherever the user wrote an observation function.
    * ``log_density(c, inputs, k, t, d, X, out)`` writes log p(d | x), NaN components left out.
    """

    n: int
    m: int
    p: int
    r: int
    n_inputs: int
    n_constants: int
    dt: float
    free: np.ndarray
    prepare: Any
    initialise: Any
    propagate: Any
    observe: Any
    simulate: Any
    log_density: Any
    key: str | None


@dataclass(frozen=True)
class Constants:
    """The constant vector ``c``: parameters first, then square roots of the covariances."""

    theta: TensorVariable
    initial_mean: TensorVariable
    initial_chol: TensorVariable
    process_chol: TensorVariable | None
    observation_chol: TensorVariable | None


@lru_cache(maxsize=256)
def ensemble_machine(system: StateSpaceModel) -> Machine:
    """Compile what the ensemble and particle filters need of a system."""
    merged = merged_noise(system)
    blocks = _covariance_blocks(system, merged)
    c, constants = _constants(system, blocks)
    symbols = {name: symbols_of(system)[name] for name in "xutd"} | {"theta": constants.theta}
    n_noises = system.m if merged is None else system.n
    z = {
        size: pt.tensor("z", shape=(size,), dtype="float64")
        for size in (system.n, n_noises, system.r)
    }

    def members(
        name: str, arguments: str, output: TensorVariable, target: str, *inputs: str, n_z: int = 0
    ) -> CompiledFunction:
        graph_inputs = {"theta": c, **{i: symbols[i] for i in inputs}}
        if n_z:
            graph_inputs["z"] = z[n_z]
        return member_function(name, arguments, Graph(graph_inputs, [output]), target)

    initial = constants.initial_mean + constants.initial_chol @ z[system.n]
    noise = _coloured(constants.process_chol, z[n_noises])
    if merged is None:
        step = call(system.equations.transition, system, symbols | {"q": noise})
    else:
        step = call(system.equations.transition, system, symbols) + noise
    e = _coloured(constants.observation_chol, z[system.r])
    parts = {
        "initialise": members("initialise", "c, Z, X", initial, "X[{i}, member]", n_z=system.n),
        "propagate": members(
            "propagate",
            "c, inputs, k, t, Z, X",
            step,
            "X[{i}, member]",
            *"xut",
            n_z=n_noises,
        ),
        "log_density": members(
            "log_density",
            "c, inputs, k, t, d, X, out",
            pt.atleast_1d(_log_density(system, symbols)),
            "out[member]",
            *"xutd",
        ),
    }
    if system.equations.observation is not None:
        seen = call(system.equations.observation, system, symbols | {"e": e})
        parts["observe"] = members(
            "observe", "c, inputs, k, t, Z, X, D", seen, "D[{i}, member]", *"xut", n_z=system.r
        )
    prepare = _prepare(system, blocks)
    keys = [prepare.key, *(part.key for part in parts.values())]
    simulate = parts["observe"].function if "observe" in parts else None
    carried = [system.states.index(name) for name in system.carried]
    return Machine(
        n=system.n,
        m=n_noises,
        p=system.p,
        r=system.r,
        n_inputs=system.n_inputs,
        n_constants=c.type.shape[0],
        dt=system.dt,
        free=np.setdiff1d(np.arange(system.n), carried),
        prepare=prepare.function,
        **{name: parts[name].function for name in ("initialise", "propagate", "log_density")},
        observe=simulate if system.gaussian_observation else None,
        simulate=simulate,
        key=key_of(repr((system.dt, carried)), *keys),
    )


def _covariance_blocks(
    system: StateSpaceModel, merged: FrozenFunctionGraph | None
) -> dict[str, FrozenFunctionGraph]:
    """Covariances whose square root noise is coloured with; an integrator's noise is white."""
    graphs = vars(system.equations) | ({} if merged is None else {"process_noise": merged})
    names = ("initial_cov", "process_noise", "observation_noise")
    return {name: graphs[name] for name in names if graphs[name] is not None}


def _constants(
    system: StateSpaceModel, blocks: Mapping[str, FrozenFunctionGraph]
) -> tuple[TensorVariable, Constants]:
    sizes = {name: graph.outputs[0].type.shape[0] for name, graph in blocks.items()}
    length = system.n_theta + system.n + sum(size**2 for size in sizes.values())
    c = pt.tensor("c", shape=(length,), dtype="float64")
    start = system.n_theta + system.n
    chols: dict[str, TensorVariable] = {}
    for name, size in sizes.items():
        chols[name] = c[start : start + size**2].reshape((size, size))
        start += size**2
    return c, Constants(
        theta=c[: system.n_theta],
        initial_mean=c[system.n_theta : system.n_theta + system.n],
        initial_chol=chols["initial_cov"],
        process_chol=chols.get("process_noise"),
        observation_chol=chols.get("observation_noise"),
    )


def _coloured(chol: TensorVariable | None, z: TensorVariable) -> TensorVariable:
    return z if chol is None else chol @ z


def _log_density(system: StateSpaceModel, symbols: Mapping[str, TensorVariable]) -> TensorVariable:
    """log p(d | x); Gaussian noise through D Gamma D^T at e = 0 (Eqs. 4.4, 4.12)."""
    if system.equations.observation_logp is not None:
        return call(system.equations.observation_logp, system, symbols)
    mean, cov = observation_moments(system, symbols)
    return log_normal(*without_missing(symbols["d"], mean, cov))


def _prepare(
    system: StateSpaceModel, blocks: Mapping[str, FrozenFunctionGraph]
) -> CompiledFunction:
    """theta -> c: parameters, initial mean, then the lower square root of every covariance."""
    theta = pt.tensor("theta", shape=(system.n_theta,), dtype="float64")
    mean = call(system.equations.initial_mean, system, {"theta": theta})
    return _followed_by_roots([theta, mean], system, theta, blocks)


def _followed_by_roots(
    outputs: Sequence[TensorVariable],
    system: StateSpaceModel,
    theta: TensorVariable,
    blocks: Mapping[str, FrozenFunctionGraph],
) -> CompiledFunction:
    """theta -> these vectors, then the lower square root of every covariance, in one array."""
    covs = [call(graph, system, {"theta": theta}) for graph in blocks.values()]
    graph = Graph({"theta": theta}, [pt.concatenate([*outputs, *(cov.ravel() for cov in covs)])])
    flat = vector_functions({"moments": VectorFunction("c", graph)})["moments"]
    length, sizes = graph.outputs[0].type.shape[0], tuple(cov.type.shape[0] for cov in covs)
    moments, first = flat.function, length - sum(size**2 for size in sizes)
    SQUARE_ROOT.compile()
    take_root = SQUARE_ROOT.external

    def prepare(theta):
        c = np.empty(length)
        values = moments(theta)
        for i in range(c.size):
            c[i] = values[i]
        start = first
        for size in sizes:
            take_root(c[start:].ctypes.data, size)
            start += size * size
        return c

    return CompiledFunction(jit(prepare), key_of(repr((length, sizes)), flat.key, SQUARE_ROOT.key))


def covariance_check(system: StateSpaceModel) -> CompiledFunction:
    """``check(theta)``: whether every covariance is symmetric and non-negative at theta.

    A filter of moments would go on with a negative variance and give it a likelihood.
    """
    blocks = {
        name: graph
        for name, graph in _covariance_blocks(system, None).items()
        if any(graph.inputs[0] in node.inputs for node in graph.apply_nodes)
    }
    if not blocks:
        return CompiledFunction(jit(lambda theta: True), key_of("nothing to check"))
    theta = pt.tensor("theta", shape=(system.n_theta,), dtype="float64")
    prepare = _followed_by_roots([], system, theta, blocks)
    roots = prepare.function

    def check(theta):
        for value in roots(theta):
            if np.isnan(value):
                return False
        return True

    return CompiledFunction(jit(check), key_of("check", prepare.key))


@jit
def semidefinite_cholesky(a):
    """Lower square root in place; a zero pivot gives a zero column, a negative one NaN.

    Covariances without spread in some direction are ordinary here: a known initial state, noise
    that acts on the velocity alone. Zero is judged against the component's own variance: one may be
    in pascals, the next in metres.
    """
    n = a.shape[0]
    variance = np.empty(n)
    for j in range(n):
        variance[j] = a[j, j]
    for j in range(n):
        pivot = a[j, j]
        for k in range(j):
            pivot -= a[j, k] ** 2
        if pivot < -1e-10 * abs(variance[j]) or not np.isfinite(pivot):
            a[:] = np.nan
            return
        root = np.sqrt(pivot) if pivot > 1e-14 * variance[j] else 0.0
        a[j, j] = root
        for i in range(j + 1, n):
            rest = a[i, j]
            for k in range(j):
                rest -= a[i, k] * a[j, k]
            if root > 0.0:
                a[i, j] = rest / root
            elif abs(rest) > 1e-7 * np.sqrt(variance[i] * variance[j]):
                a[:] = np.nan
                return
            else:
                a[i, j] = 0.0
        for i in range(j):
            a[i, j] = 0.0


def _take_root(a, size):
    semidefinite_cholesky(carray(a, (size, size)))


SQUARE_ROOT = EntryPoint(_take_root, (F64_PTR, types.intp), "square_root", digest("square_root"))
"""`semidefinite_cholesky` of the matrix at an address, compiled once for all systems."""
