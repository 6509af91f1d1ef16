"""Backward simulation: paths drawn through the weighted particles, last state first.

A state at step k is drawn among the particles there with weights

    w_i N(x_{k+1}; g(x_i, 0), B(x_i) B(x_i)^T),

where x_{k+1} is the state already drawn (Godsill, Doucet and West 2004). What was resampled, or
nudged, does not matter: only the weighted particles of each step do. The process noise must be
additive, g(x, q) = g(x, 0) + B(x) q, and reach every state.

Particles are proposed with their weights alone and accepted by their density over the largest
there can be (Douc, Garivier, Moulines and Olsson 2011), which costs a few tries; after some all
weights are computed.
"""

import math
from typing import Any

import numpy as np
from numba import carray, types

from pymc_statespace_filters.compiler.lowering.ensemble import Machine
from pymc_statespace_filters.compiler.native.cache_key import digest
from pymc_statespace_filters.compiler.native.entry_point import (
    F64_PTR,
    I64_PTR,
    EntryPoint,
    address_of,
)
from pymc_statespace_filters.compiler.native.jit import inline_always, keep_alive, njit_contract
from pymc_statespace_filters.compiler.numerics.philox import STATES, key_words, open_unit, philox
from pymc_statespace_filters.compiler.numerics.restricted_domain import exp
from pymc_statespace_filters.compiler.numerics.small_cholesky import cholesky, solve_lower
from pymc_statespace_filters.filters.ensemble.callbacks import CALLBACK_ARGUMENTS, FORECAST, UPDATED
from pymc_statespace_filters.filters.ensemble.summaries import (
    choose,
    finite_weights,
    forget_row,
    results,
)
from pymc_statespace_filters.filters.ensemble.system_table import propagate, read_system
from pymc_statespace_filters.filters.ensemble.weights import normalise
from pymc_statespace_filters.filters.outcomes import COVARIANCE_NOT_POSITIVE, NONE

PARTICLES_PER_PATH = 16
_LEAST_PATHS = 16
_TRIES_PER_PARTICLE = 1 / 4  # a try costs about four times what a particle costs in a full sweep

_N_COUNTS = 2


def _store(counts, numbers, event, j, k, members, log_weights, d, simulated, ancestors):
    """Keep the particles (n, N) of every step and their log weights (N,), updated or not."""
    of = carray(counts, (_N_COUNTS,))
    n, N = of[0], of[1]
    if event == FORECAST or event == UPDATED:
        size = (n + 1) * N
        at = carray(numbers, ((k + 1) * size,))[k * size :]
        X, log_w = carray(members, (n * N,)), carray(log_weights, (N,))
        at[: n * N] = X
        at[n * N :] = log_w


STORE = EntryPoint(_store, CALLBACK_ARGUMENTS, "store_particles", digest("store_particles"))

_ARGUMENTS = (
    I64_PTR, types.float64,  # table of the system and its time step
    types.intp, types.intp, types.intp, types.intp,  # particles, noises, paths, steps
    F64_PTR, types.intp,  # theta
    F64_PTR, types.intp,  # rows of inputs
    types.float64, types.int64,  # t0, seed of the draws
    F64_PTR,  # what was stored
    I64_PTR, types.intp,  # rows
    F64_PTR, F64_PTR,  # results, and whether all went well
)  # fmt: skip


def _walk_back(
    table, dt, N, m, M, n_steps, theta, n_theta, inputs, n_rows, t0, seed,
    stored, rows, R, numbers, succeeded,
):  # fmt: skip
    system = read_system(table, dt, theta, n_theta, inputs, n_rows)
    n, width = system.n, -(-N // 64) * 64
    size = (n + 1) * N
    tape = carray(stored, ((n_steps + 1) * size,))
    at, out = carray(rows, (R,)), carray(numbers, ((3 * n + 1) * R,))
    paths, chosen = np.empty((M, n)), np.empty(M, np.int64)
    kernel = (np.empty((n, N)), np.empty((N, n, n)), np.empty(N))
    noise, scratch = np.zeros((m, width)), np.empty((n, N))
    shares = (np.empty(N), np.empty(N, np.int64))
    row = R - 1
    carray(succeeded, (1,))[0] = 0.0
    for k in range(n_steps, -1, -1):
        here = tape[k * size : (k + 1) * size]
        X = here[: n * N].reshape(n, N)
        w = finite_weights(X, here[n * N :])
        _share_out(w, shares)
        if k == n_steps:
            for path in range(M):
                u, _ = _uniforms(seed, 0, path, k)
                chosen[path] = _find(shares, u)
        else:
            if not _kernels(system, k, t0 + k * dt, X, w, noise, scratch, kernel):
                return
            _choose_particles(seed, k, w, shares, kernel, paths, chosen)
        for path in range(M):
            for a in range(n):
                paths[path, a] = X[a, chosen[path]]
        if row >= 0 and at[row] == k:
            _summarise_paths(out, R, row, paths, chosen, N)
            row -= 1
    carray(succeeded, (1,))[0] = 1.0


@njit_contract
def _kernels(system, k, t, X, w, noise, scratch, kernel):
    """Means, lower roots of covariances and log-constants of the next state from each particle."""
    means, roots, log_constants = kernel
    n, N = X.shape
    m, width = noise.shape
    means[:] = X
    noise[:] = 0.0
    propagate(system, k, t, noise.ctypes.data, width, means)
    roots[:] = 0.0
    for q in range(m):
        noise[q] = 1.0
        scratch[:] = X
        propagate(system, k, t, noise.ctypes.data, width, scratch)
        noise[q] = 0.0
        for i in range(N):
            for a in range(n):
                for b in range(n):
                    roots[i, a, b] += (scratch[a, i] - means[a, i]) * (scratch[b, i] - means[b, i])
    for i in range(N):
        log_constants[i] = -np.inf
        if w[i] > 0.0:
            if not cholesky(roots[i]):
                return False
            log_constants[i] = 0.0
            for a in range(n):
                log_constants[i] -= math.log(roots[i, a, a])
    return True


@njit_contract
def _choose_particles(seed, k, w, shares, kernel, paths, chosen):
    """Draw for every path the particle from which it came."""
    log_constants, N = kernel[2], w.size
    residual, log_w, weights = np.empty(paths.shape[1]), np.empty(N), np.empty(N)
    highest = log_constants.max()
    n_tries = max(16, int(N * _TRIES_PER_PARTICLE))
    for path in range(len(paths)):
        found = False
        for attempt in range(n_tries):
            u, v = _uniforms(seed, attempt, path, k)
            i = _find(shares, u)
            if v < exp(_log_density(kernel, i, paths[path], residual) - highest):
                chosen[path], found = i, True
                break
        if not found:
            for i in range(N):
                log_w[i] = -np.inf
                if w[i] > 0.0:
                    log_w[i] = math.log(w[i]) + _log_density(kernel, i, paths[path], residual)
            u, _ = _uniforms(seed, n_tries, path, k)
            if normalise(log_w, weights) > -np.inf:
                chosen[path] = choose(weights, u)
            else:  # too far from all to tell
                chosen[path] = _find(shares, u)


@inline_always
def _log_density(kernel, i, x, residual):
    """log N(x; mean_i, root_i root_i^T) without what is the same for all."""
    means, roots, log_constants = kernel
    for a in range(x.size):
        residual[a] = x[a] - means[a, i]
    solve_lower(roots[i], residual)
    square = 0.0
    for a in range(x.size):
        square += residual[a] * residual[a]
    return log_constants[i] - 0.5 * square


@inline_always
def _uniforms(seed, attempt, path, k):
    """Two uniform numbers of their own."""
    k0, k1 = key_words(seed)
    words = philox(np.uint64(attempt), np.uint64(path + 1), np.uint64(k), STATES, k0, k1)
    return open_unit(words[0], words[1]), open_unit(words[2], words[3])


@njit_contract
def _share_out(w, shares):
    """Cumulative weights, and for each of N equal parts of them the particle where it begins."""
    cumulative, begins = shares
    N, total = w.size, 0.0
    for i in range(N):
        total += w[i]
        cumulative[i] = total
    i = 0
    for part in range(N):
        while i < N - 1 and cumulative[i] * N <= part * total:
            i += 1
        begins[part] = i


@inline_always
def _find(shares, u):
    """The particle in whose share of the weight a number of (0, 1) falls, after a step or two."""
    cumulative, begins = shares
    N = cumulative.size
    i, place = begins[min(N - 1, int(u * N))], u * cumulative[N - 1]
    while i < N - 1 and cumulative[i] <= place:
        i += 1
    return i


@njit_contract
def _summarise_paths(out, n_rows, row, paths, chosen, N):
    """Mean, deviation and the first of the paths; the number of distinct particles in them."""
    M, n = paths.shape
    moments = out[: 3 * n * n_rows].reshape(3, n_rows, n)
    for a in range(n):
        mean, square = 0.0, 0.0
        for path in range(M):
            mean += paths[path, a] / M
        for path in range(M):
            square += (paths[path, a] - mean) ** 2
        moments[0, row, a], moments[1, row, a] = mean, math.sqrt(square / (M - 1))
        moments[2, row, a] = paths[0, a]
    seen, count = np.zeros(N, np.bool_), 0
    for i in chosen:
        if not seen[i]:
            seen[i] = True
            count += 1
    out[3 * n * n_rows + row] = count


WALK_BACK = EntryPoint(_walk_back, _ARGUMENTS, "walk_back", digest("walk_back"))


def backward_kernel(evaluate: Any, make_table: Any, machine: Machine, n_particles: int) -> Any:
    """The function (theta, steps, observed, inputs, t0, seed, rows, draw_seed) -> states.

    Parameters
    ----------
    evaluate, make_table : njit functions
        Of a filter and a system, see `EnsembleFilter.with_callback` and `EnsembleFilter.table`.
    machine : Machine
    n_particles : int
    """
    for entry in (STORE, WALK_BACK):
        entry.compile()
    witness, walk_back = STORE.symbol, WALK_BACK.external
    n, m, dt, N = machine.n, machine.m, machine.dt, n_particles
    M = max(_LEAST_PATHS, N // PARTICLES_PER_PATH)

    @njit_contract
    def run(theta, steps, observed, inputs, t0, seed, rows, draw_seed):
        R, n_steps = rows.size, steps[-1] if steps.size else np.int64(0)
        counts, stored = np.array([n, N]), np.empty((n_steps + 1) * (n + 1) * N)
        numbers, succeeded = np.full((3 * n + 1) * R, np.nan), np.zeros(1)
        watch = (address_of(witness), np.int64(counts.ctypes.data), np.int64(stored.ctypes.data))
        _, health = evaluate(theta, steps, observed, inputs, t0, (seed, np.empty(0)), watch)
        keep_alive(counts)
        if health[1] == NONE:
            table = make_table()
            walk_back(
                table.ctypes.data, dt, N, m, M, n_steps, theta.ctypes.data, theta.size,
                inputs.ctypes.data, inputs.shape[0], t0, draw_seed, stored.ctypes.data,
                rows.ctypes.data, R, numbers.ctypes.data, succeeded.ctypes.data,
            )  # fmt: skip
            keep_alive(table)
            if succeeded[0] == 0.0:
                health[1], health[2] = COVARIANCE_NOT_POSITIVE, 0.0
                for row in range(R):
                    forget_row(numbers, n, R, row)
        return results(numbers, n, R, health)

    return run
