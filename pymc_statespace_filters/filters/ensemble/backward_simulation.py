"""Backward simulation: paths drawn through the weighted particles, last state first.

A state at step k is drawn among the particles there with weights

    w_i N(x_{k+1}; g(x_i, 0), B(x_i) B(x_i)^T),

where x_{k+1} is the state already drawn (Godsill, Doucet and West 2004). Resampling and Kalman
updates do not matter: only the weighted particles of each step do. The process noise must be
additive, g(x, q) = g(x, 0) + B(x) q, and reach every state, or none during a step of length zero.

Particles are proposed in proportion to their weights w_i and accepted with the ratio of the normal
density to its upper bound (Douc, Garivier, Moulines and Olsson 2011), which takes a few tries. If
these fail, all weights are computed.
"""

import math
from collections.abc import Callable

import numpy as np
from numba import carray

from ...compiler.native.entry_point import EntryPoint
from ...compiler.native.jit import copy_into, inline_always, njit_internal
from ...compiler.native.plan import HEALTH_SIZE, RECORD, REQUEST, RESULTS, plan_entry
from ...compiler.numerics.philox import STATES, key_words, open_unit, philox
from ...compiler.numerics.restricted_domain import exp
from ...compiler.numerics.small_cholesky import cholesky, solve_lower
from ..calls import OK, opened, reals_at, single_record, wanted_rows
from ..outcomes import NO_PROCESS_NOISE, NONE
from ..plan import PLAN, propagate, read_system
from .callbacks import CALLBACK_ARGUMENTS, FORECAST, UPDATED, run_observed
from .evaluation import layout_of
from .part_moments import choose
from .summaries import finite_weights, forget, n_distinct, places_of
from .weights import normalise

PARTICLES_PER_PATH = 16
_LEAST_PATHS = 16
_ROUNDING = 1e-10  # of a state, relative to the largest of all particles
_TRIES_PER_PARTICLE = 1 / 4  # a try costs about four times what a particle costs in a full sweep


def _store(integers, reals, event, j, k, X, log_w, d, D, ancestors):
    """Keep the particles (n, N) of every step and their log weights (N,), updated or not."""
    n, N = carray(integers, (2,))
    if event == FORECAST or event == UPDATED:
        size = (n + 1) * N
        at = carray(reals, ((k + 1) * size,))[k * size :]
        copy_into(at[: n * N], carray(X, (n * N,)))
        copy_into(at[n * N :], carray(log_w, (N,)))


STORE = EntryPoint(_store, CALLBACK_ARGUMENTS, "store_particles")


def path_smoother(name: str, simulate: Callable) -> EntryPoint:
    """An entry point that runs a filter, stores its particles, and draws paths back through them.

    ``simulate(call, record, stored, n_paths, rows)`` writes results of the rows, from the particles
    and log weights of all steps (K, rows of a particle + 1, N). It returns a code of
    `filters.outcomes`.
    """

    def smooth(plan, record, request, results):
        status, call = opened(plan, record, request, results)
        if status != OK:
            return status
        layout, _ = layout_of(call.plan)
        n, N = layout.order.size, call.plan[PLAN.n_members]
        call.results[RESULTS.n_states] = n
        if call.request[REQUEST.sizes_only]:
            return status
        data = single_record(call, 0, 0, call.record[RECORD.n_rows])
        n_steps = data.steps[-1] if data.steps.size else np.int64(0)
        stored = np.empty((n_steps + 1, layout.rows + 1, N))
        integers, reals = np.array([layout.rows, N]), stored.reshape(stored.size)
        status, _, health = run_observed(call, plan, record, integers, reals)
        forget(call, n, 0)
        if health[1] == NONE:
            n_paths = max(_LEAST_PATHS, N // PARTICLES_PER_PATH)
            code = simulate(call, data, stored, n_paths, wanted_rows(call))
            if code != NONE:
                forget(call, n, 0)
                health[1], health[2] = code, 0.0
        copy_into(reals_at(call.results[RESULTS.health], (HEALTH_SIZE,)), health)
        return status

    return plan_entry(smooth, name, (simulate,))


@njit_internal
def _simulate(call, record, stored, M, rows):
    """Draw paths of states; a failure if a covariance of a step is singular."""
    system, seed = (
        read_system(call.plan, record.theta, record.inputs),
        call.request[REQUEST.draw_seed],
    )
    (n_steps, n, N), row = stored.shape, rows.size - 1
    n_steps, n = n_steps - 1, n - 1
    width = -(-N // 64) * 64
    paths, chosen = np.empty((M, n)), np.empty(M, np.int64)
    kernel = (np.empty((n, N)), np.empty((N, n, n)), np.empty(N))
    noise, scratch = np.zeros((system.m, width)), np.empty((n, N))
    intervals = (np.empty(N), np.empty(N, np.int64))
    for k in range(n_steps, -1, -1):
        X = stored[k, :n]
        w = finite_weights(X, stored[k, n])
        _fill_intervals(w, intervals)
        if k == n_steps:
            for path in range(M):
                u, _ = _uniforms(seed, 0, path, k)
                chosen[path] = _find(intervals, u)
        else:
            if not _kernels(system, k, record.t0 + k * system.dt, X, w, noise, scratch, kernel):
                return NO_PROCESS_NOISE
            _choose_particles(seed, k, w, intervals, kernel, paths, chosen)
        for path in range(M):
            for a in range(n):
                paths[path, a] = X[a, chosen[path]]
        if row >= 0 and rows[row] == k:
            _write_row(call.results, row, paths, n_distinct(chosen, N))
            row -= 1
    return NONE


@njit_internal
def _kernels(system, k, t, X, w, noise, scratch, kernel):
    """Means, lower roots of covariances and log-constants of the next state from each particle."""
    means, roots, log_constants = kernel
    n, N = X.shape
    m, width = noise.shape
    for a in range(n):
        copy_into(means[a], X[a])
    noise[:] = 0.0
    propagate(system, k, t, noise.ctypes.data, width, means)
    roots[:] = 0.0
    for q in range(m):
        noise[q] = 1.0
        for a in range(n):
            copy_into(scratch[a], X[a])
        propagate(system, k, t, noise.ctypes.data, width, scratch)
        noise[q] = 0.0
        for i in range(N):
            for a in range(n):
                for b in range(n):
                    roots[i, a, b] += (scratch[a, i] - means[a, i]) * (scratch[b, i] - means[b, i])
    if not roots.any():
        _spread_over_rounding(means, roots)
    for i in range(N):
        log_constants[i] = -np.inf
        if w[i] > 0.0:
            if not cholesky(roots[i]):
                return False
            log_constants[i] = 0.0
            for a in range(n):
                log_constants[i] -= math.log(roots[i, a, a])
    return True


@njit_internal
def _spread_over_rounding(means, covs):
    """Covariances of a step without noise, as one of length zero: a state is where it went."""
    n, N = means.shape
    for a in range(n):
        highest = 0.0
        for i in range(N):
            highest = max(highest, abs(means[a, i]))
        sd = _ROUNDING * highest if highest > 0.0 else 1.0
        for i in range(N):
            covs[i, a, a] = sd * sd


@njit_internal
def _choose_particles(seed, k, w, intervals, kernel, paths, chosen):
    """Draw for every path the particle from which it came."""
    log_constants, N = kernel[2], w.size
    residual, log_w, weights = np.empty(paths.shape[1]), np.empty(N), np.empty(N)
    highest = log_constants.max()
    n_tries = max(16, int(N * _TRIES_PER_PARTICLE))
    for path in range(len(paths)):
        found = False
        for attempt in range(n_tries):
            u, v = _uniforms(seed, attempt, path, k)
            i = _find(intervals, u)
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
                chosen[path] = _find(intervals, u)


@njit_internal
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


@njit_internal
def _fill_intervals(w, intervals):
    """Cumulative weights, and for each of N equal parts of them the particle where it begins."""
    cumulative, begins = intervals
    N, total = w.size, 0.0
    for i in range(N):
        total += w[i]
        cumulative[i] = total
    i = 0
    for part in range(N):
        while i < N - 1 and cumulative[i] * N <= part * total:
            i += 1
        begins[part] = i


@njit_internal
def _find(intervals, u):
    """The particle in whose interval a number of (0, 1) falls, in O(1) on average."""
    cumulative, begins = intervals
    N = cumulative.size
    i, place = begins[min(N - 1, int(u * N))], u * cumulative[N - 1]
    while i < N - 1 and cumulative[i] <= place:
        i += 1
    return i


@njit_internal
def _write_row(to, row, paths, n_particles):
    """Write mean, deviation and the first of the paths, and how many particles all come from."""
    M, n = paths.shape
    means, sds, drawn, n_effective = places_of(to, n, row)
    for a in range(n):
        mean, square = 0.0, 0.0
        for path in range(M):
            mean += paths[path, a] / M
        for path in range(M):
            square += (paths[path, a] - mean) ** 2
        means[a], sds[a], drawn[a] = mean, math.sqrt(square / (M - 1)), paths[0, a]
    n_effective[0] = n_particles


SMOOTH = path_smoother("backward_simulation", _simulate)
"""Smoothed states by backward simulation."""
