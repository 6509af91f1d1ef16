"""Smoothed states of filters of regimes: paths drawn back through the mixtures of all steps.

At every step such a filter leaves a mixture: parts with weights w_i, each a regime with a normal
distribution of the continuous states. Given regime and state x' after a step, a path comes from
part i, by a draw v of the finite variables that leads to this regime, in proportion to

    w_i P(v | i) N(x'; m', P'),

with the mean m' and covariance P' that the filter predicts for this move. The state before the step
is normal with the mean m + G (x' - m') and the covariance P - G C', where C is the covariance of
the states before and after the step, and G = C P'^-1. Nothing is approximated but the mixtures.

W. Fong, S. J. Godsill, A. Doucet and M. West, "Monte Carlo smoothing with application to audio
signal enhancement", IEEE Transactions on Signal Processing 50 (2002), for particles.

Means and deviations are those of the parts given the paths, which vary less than drawn states.
"""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import copy_into, njit_internal
from ...compiler.native.plan import REQUEST
from ...compiler.numerics.philox import STATES, uniform_at
from ...compiler.numerics.small_cholesky import (
    cholesky,
    semidefinite_cholesky,
    solve_lower,
    solve_lower_transposed,
)
from ..ensemble.backward_simulation import path_smoother
from ..ensemble.evaluation import layout_of
from ..ensemble.part_moments import choose, normal_at
from ..ensemble.summaries import finite_weights, n_distinct, places_of
from ..ensemble.weights import normalise
from ..outcomes import NONE
from ..plan import NULL, PLAN, call_members, read_system

# Where a step leaves no spread, a state is taken to be within these of its mean: relative to the
# deviation, and to the value itself.
_OF_VARIANCE, _OF_SQUARE = 1e-12, 1e-24
_LEAST_VARIANCE = 1e-290


class Mixtures(NamedTuple):
    """The mixtures of all steps, and the function of their `moves` by its address.

    ``stored`` (steps, rows + 1, N) has a row for each number of a part, and one of log-weights;
    ``order`` tells where each state of the system is among the finite states, followed by the
    others. ``c`` and ``inputs`` are those of the function, of ``n_draws`` moves for each part.
    """

    stored: np.ndarray
    n_finite: int
    order: np.ndarray
    moves: int
    n_draws: int
    c: np.ndarray
    inputs: np.ndarray
    t0: float
    dt: float


class Moves(NamedTuple):
    """What may have happened before a state: a row for each part and draw.

    The state before the step is normal, of the mean ``mean`` + ``gain`` (x' - ``forecast``) and the
    covariance ``cov``; ``variance`` is that without x', whose covariance has the factor ``chol``.
    """

    log_w: np.ndarray
    part: np.ndarray
    successor: np.ndarray
    mean: np.ndarray
    variance: np.ndarray
    cov: np.ndarray
    forecast: np.ndarray
    chol: np.ndarray
    gain: np.ndarray


@njit_internal
def _room_for_moves(A, n_finite, n):
    return Moves(
        log_w=np.empty(A), part=np.empty(A, np.int64), successor=np.empty((A, n_finite)),
        mean=np.empty((A, n)), variance=np.empty((A, n)), cov=np.empty((A, n, n)),
        forecast=np.empty((A, n)), chol=np.empty((A, n, n)), gain=np.empty((A, n, n)),
    )  # fmt: skip


@njit_internal
def _unpack(rows, i, mean, cov):
    """Read mean and lower triangle from a column."""
    n = mean.size
    copy_into(mean, rows[:n, i])
    place = n
    for a in range(n):
        for b in range(a + 1):
            cov[a, b] = cov[b, a] = rows[place, i]
            place += 1


@njit_internal
def _condition_on_next(moves, a):
    """Make factor, gain and covariance of those of both states; False if they are none."""
    chol, gain, cov, n = moves.chol[a], moves.gain[a], moves.cov[a], moves.mean.shape[1]
    for i in range(n):
        moves.variance[a, i] = cov[i, i]
        slack = _OF_VARIANCE * chol[i, i] + _OF_SQUARE * moves.forecast[a, i] ** 2
        chol[i, i] += slack + _LEAST_VARIANCE
    if not cholesky(chol):
        return False
    for i in range(n):
        solve_lower(chol, gain[i])
        moves.log_w[a] -= math.log(chol[i, i])
        for j in range(i + 1):
            for b in range(n):
                cov[i, j] -= gain[i, b] * gain[j, b]
            cov[j, i] = cov[i, j]
    for i in range(n):
        solve_lower_transposed(chol, gain[i])
    return True


@njit_internal
def _fill_moves(mixtures, k, X, w, moves):
    """The moves from step k to k + 1, whose weights are those of the parts at step k."""
    n_finite, n, N = mixtures.n_finite, moves.mean.shape[1], w.size
    size, t = X.shape[0] - n_finite, mixtures.t0 + k * mixtures.dt
    width = 1 + n_finite + 2 * size + n * n
    out = np.empty((mixtures.n_draws * width, N))
    call_members(mixtures.moves, mixtures, k, t, NULL, NULL, X, out)
    for draw in range(mixtures.n_draws):
        rows = out[draw * width : (draw + 1) * width]
        for i in range(N):
            a, weight = draw * N + i, w[i] * rows[0, i]
            moves.part[a], moves.log_w[a] = i, -np.inf
            if not weight > 0.0:
                continue
            moves.log_w[a] = math.log(weight)
            copy_into(moves.successor[a], rows[1 : 1 + n_finite, i])
            before = rows[1 + n_finite :]
            _unpack(before, i, moves.mean[a], moves.cov[a])
            _unpack(before[size:], i, moves.forecast[a], moves.chol[a])
            for b in range(n * n):
                moves.gain[a, b // n, b % n] = before[2 * size + b, i]
            if not _condition_on_next(moves, a):
                moves.log_w[a] = -np.inf


@njit_internal
def _fill_ends(X, w, n_finite, moves):
    """The parts of the last step, after which nothing is known."""
    moves.log_w[:] = -np.inf
    for i in range(w.size):
        moves.part[i] = i
        if w[i] > 0.0:
            moves.log_w[i] = math.log(w[i])
        _unpack(X[n_finite:], i, moves.mean[i], moves.cov[i])
        for a in range(moves.mean.shape[1]):
            moves.variance[i, a] = moves.cov[i, a, a]
    moves.gain[:] = 0.0
    moves.forecast[:] = 0.0


@njit_internal
def _weights_given_next(moves, is_last, path, n_finite, log_p, p):
    """Write the probabilities of the moves given regime and state after them, if there are any."""
    n = moves.mean.shape[1]
    residual = np.empty(n)
    for a in range(log_p.size):
        log_p[a] = moves.log_w[a]
        if is_last or log_p[a] == -np.inf:
            continue
        for i in range(n_finite):
            if moves.successor[a, i] != path[i]:
                log_p[a] = -np.inf
        if log_p[a] > -np.inf:
            for i in range(n):
                residual[i] = path[n_finite + i] - moves.forecast[a, i]
            solve_lower(moves.chol[a], residual)
            for i in range(n):
                log_p[a] -= 0.5 * residual[i] * residual[i]
    if normalise(log_p, p) == -np.inf:  # too far from all to tell
        copy_into(log_p, moves.log_w)
        normalise(log_p, p)


@njit_internal
def _mean_given_next(moves, a, path, n_finite, mean):
    """Write the mean of the state before a move, given that after it."""
    for i in range(mean.size):
        mean[i] = moves.mean[a, i]
        for j in range(mean.size):
            mean[i] += moves.gain[a, i, j] * (path[n_finite + j] - moves.forecast[a, j])


@njit_internal
def _moments_given_next(moves, X, p, path, n_finite, mean, variance):
    """Write mean and variances of regime and state before the moves, of these probabilities."""
    n_moves, n = p.size, moves.mean.shape[1]
    found = np.empty((n_moves, n_finite + n))
    mean[:], variance[:] = 0.0, 0.0
    for a in range(n_moves):
        if p[a] > 0.0:
            copy_into(found[a, :n_finite], X[:n_finite, moves.part[a]])
            _mean_given_next(moves, a, path, n_finite, found[a, n_finite:])
            for i in range(mean.size):
                mean[i] += p[a] * found[a, i]
    for a in range(n_moves):
        if p[a] > 0.0:
            for i in range(mean.size):
                within = moves.cov[a, i - n_finite, i - n_finite] if i >= n_finite else 0.0
                variance[i] += p[a] * (max(within, 0.0) + (found[a, i] - mean[i]) ** 2)


@njit_internal
def _draw_before(moves, a, X, n_finite, seed, k, first, path):
    """Replace regime and state of a path by those before a move."""
    n = moves.mean.shape[1]
    mean, root, floor = np.empty(n), moves.cov[a].copy(), np.empty(n)
    _mean_given_next(moves, a, path, n_finite, mean)
    for i in range(n):
        floor[i] = _OF_VARIANCE * moves.variance[a, i]
    semidefinite_cholesky(root, floor, np.empty(n, np.bool_))
    copy_into(path[:n_finite], X[:n_finite, moves.part[a]])
    for j in range(n):
        z = normal_at(seed, k, first + 2 * j)
        for i in range(j, n):
            mean[i] += root[i, j] * z
    copy_into(path[n_finite:], mean)


@njit_internal
def _write_row(to, row, order, means, variances, path, n_parts):
    """Write mean, deviation and the first path; and how many parts all of them come from."""
    M, n = means.shape
    mean, sd, drawn, n_effective = places_of(to, n, row)
    for a in range(n):
        column, total, between = order[a], 0.0, 0.0
        mean[a] = means[:, column].mean()
        for m in range(M):
            total += variances[m, column] / M
            between += (means[m, column] - mean[a]) ** 2 / (M - 1)
        sd[a], drawn[a] = math.sqrt(total + between), path[column]
    n_effective[0] = n_parts


@njit_internal
def simulate_backward(mixtures, n_paths, seed, rows, to):
    """Write the results of the wanted rows."""
    last, n_finite = mixtures.stored.shape[0] - 1, mixtures.n_finite
    N, n = mixtures.stored.shape[2], mixtures.order.size - n_finite
    paths, parts = np.zeros((n_paths, n_finite + n)), np.empty(n_paths, np.int64)
    means, variances = np.empty(paths.shape), np.empty(paths.shape)
    moves, row = _room_for_moves(mixtures.n_draws * N, n_finite, n), rows.size - 1
    log_p, p = np.empty(moves.part.size), np.empty(moves.part.size)
    for k in range(last, -1, -1):
        X = mixtures.stored[k, :-1]
        w = finite_weights(X, mixtures.stored[k, -1])
        if k == last:
            _fill_ends(X, w, n_finite, moves)
        else:
            _fill_moves(mixtures, k, X, w, moves)
        is_wanted, u = row >= 0 and rows[row] == k, uniform_at(seed, STATES, k, 0)
        for m in range(n_paths):
            _weights_given_next(moves, k == last, paths[m], n_finite, log_p, p)
            if is_wanted:
                _moments_given_next(moves, X, p, paths[m], n_finite, means[m], variances[m])
            chosen = choose(p, (u + m / n_paths) % 1.0)
            parts[m] = moves.part[chosen]
            _draw_before(moves, chosen, X, n_finite, seed, k, 1 + 2 * n * m, paths[m])
        if is_wanted:
            n_parts = n_distinct(parts, N)
            _write_row(to, row, mixtures.order, means, variances, paths[0], n_parts)
            row -= 1


@njit_internal
def _through_particles(call, record, stored, n_paths, rows):
    """The same through the particles of all steps, each with a regime and a Kalman filter."""
    (_, n_finite, order), settings = layout_of(call.plan)
    system = read_system(call.plan, record.theta, record.inputs)
    mixtures = Mixtures(
        stored=stored, n_finite=n_finite, order=order, moves=call.plan[PLAN.moves],
        n_draws=int(settings[0]), c=system.c, inputs=system.inputs, t0=record.t0, dt=system.dt,
    )  # fmt: skip
    simulate_backward(mixtures, n_paths, call.request[REQUEST.draw_seed], rows, call.results)
    return NONE


SMOOTH_PARTICLES = path_smoother("rbpf_smoother", _through_particles)
"""Smoothed states of a Rao-Blackwellised particle filter."""
