"""A deterministic filter at many parameter points at once, one SIMD lane per point.

At a single point each step waits for the one before. Further points fill that latency, so several
cost little more than one.
"""

from typing import Any

import numpy as np

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction, jit
from pymc_statespace_filters.compiler.codegen.scalarize import NotUnrollableError
from pymc_statespace_filters.compiler.codegen.simd import LANES, LANES_AT_ONCE, lane_functions
from pymc_statespace_filters.compiler.lowering.covariances import covariance_check
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.filters.gaussian.recursion import (
    GaussianFilterFunctions,
    compile_value,
    compiled_of,
)
from pymc_statespace_filters.filters.outcomes import (
    COVARIANCE_NOT_POSITIVE,
    NO_FINITE_MEMBER,
    NONE,
    is_missing,
)


def compile_batch(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta (B, k), steps, observed, inputs, t0, seed) -> terms, health."""
    try:
        group = _lanes(recursion)
    except NotUnrollableError:
        group = _one_by_one(compile_value(recursion))
    evaluate = group.function

    def batch(theta, steps, observed, inputs, t0, seed):
        n_points = theta.shape[0]
        terms = np.full((n_points, steps.size), -np.inf)
        health = np.empty((n_points, 3))
        health[:, 0], health[:, 1], health[:, 2] = np.inf, float(NONE), -1.0
        for first in range(0, n_points, LANES):
            part = slice(first, min(first + LANES, n_points))
            evaluate(theta[part], steps, observed, inputs, t0, seed, terms[part], health[part])
        return terms, health

    return compiled_of(batch, "batch", {"group": group}, recursion)


def _one_by_one(value: CompiledFunction) -> CompiledFunction:
    run = value.function

    @jit
    def group(theta, steps, observed, inputs, t0, seed, terms, health):
        for i in range(theta.shape[0]):
            terms[i], health[i] = run(theta[i].copy(), steps, observed, inputs, t0, seed)

    return CompiledFunction(group, key_of("one by one", value.key))


def _lanes(recursion: GaussianFilterFunctions) -> CompiledFunction:
    functions = {name: f for name, f in recursion.parts().items() if name != "parameters"}
    lanes = lane_functions(functions, recursion.size)
    start, predict, update = lanes.functions.values()
    prepare_start, prepare_predict, prepare_update = lanes.prepare
    valid = covariance_check(recursion.system)
    has_valid_covariances, is_finite = valid.function, _finite_mean(recursion)
    dt, last, n_rows = recursion.system.dt, lanes.last, lanes.n_rows

    @jit
    def group(theta, steps, observed, inputs, t0, seed, terms, health):
        n_lanes = -(-theta.shape[0] // LANES_AT_ONCE) * LANES_AT_ONCE
        W = np.empty(n_rows * LANES)
        nothing = np.empty(0)
        alive = np.empty(theta.shape[0], np.bool_)
        _load_parameters(theta, n_lanes, W)
        for point in range(theta.shape[0]):
            alive[point] = has_valid_covariances(theta[point].copy())
            if not alive[point]:
                health[point, 1], health[point, 2] = COVARIANCE_NOT_POSITIVE, 0.0
        prepare_start(W, n_lanes, inputs, 0, t0, nothing)
        prepare_predict(W, n_lanes, inputs, 0, t0, nothing)
        prepare_update(W, n_lanes, inputs, 0, t0, nothing)
        start(W, n_lanes, inputs, 0, t0, nothing)
        finite = np.empty(LANES, np.bool_)
        k = 0
        for j in range(steps.size):
            while k < steps[j]:
                predict(W, n_lanes, inputs, k, t0 + k * dt, nothing)
                k += 1
            if is_missing(observed, j):
                for i in range(theta.shape[0]):
                    terms[i, j] = 0.0 if alive[i] else terms[i, j]
            else:
                is_finite(W, finite)
                update(W, n_lanes, inputs, k, t0 + k * dt, observed[j])
                _store_terms(W[last * LANES :], j, finite, alive, terms, health)
            if not alive.any():
                break

    return CompiledFunction(group, key_of("lanes", lanes.key, valid.key))


@jit
def _load_parameters(theta, n_lanes, W):
    """Write the parameters of each point to its lane; spare lanes repeat the last point."""
    for lane in range(n_lanes):
        point = min(lane, theta.shape[0] - 1)
        for i in range(theta.shape[1]):
            W[i * LANES + lane] = theta[point, i]


@jit
def _store_terms(lanes, j, finite, alive, terms, health):
    """Store the finite terms of observation j; a point without one fails there."""
    for i in range(alive.size):
        if alive[i] and np.isfinite(lanes[i]):
            terms[i, j] = lanes[i]
        elif alive[i]:
            alive[i] = False
            health[i, 1] = COVARIANCE_NOT_POSITIVE if finite[i] else NO_FINITE_MEMBER
            health[i, 2] = j


def _finite_mean(recursion: GaussianFilterFunctions) -> Any:
    """``is_finite(W, finite)``: whether the mean is finite, lane by lane."""
    first, n = recursion.system.n_theta, recursion.system.n

    @jit
    def is_finite(W, finite):
        finite[:] = True
        for i in range(n):
            for lane in range(LANES):
                finite[lane] &= np.isfinite(W[(first + i) * LANES + lane])

    return is_finite
