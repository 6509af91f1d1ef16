"""States given the observations: probabilities of all states at chosen steps, and paths drawn.

The smoothed probabilities are the filtered ones times what the later observations say,

    b_i at a step = sum over the moves i -> j of P(move | i) r_j b_j of the next one, without r_j
    where nothing is observed,

and a path is drawn from the last step back, from f_i P(i -> the state drawn after it).
"""

import math

import numpy as np

from ...compiler.native.jit import copy_into, njit_internal
from ...compiler.native.plan import HEALTH_SIZE, RECORD, REQUEST, RESULTS, STATE, plan_entry
from ...compiler.numerics.philox import STATES, uniform_at
from ..calls import (
    OK,
    first_unknown,
    opened,
    reals_at,
    single_record,
    state_given,
    state_wanted,
    wanted_rows,
)
from ..outcomes import NONE, OUT_OF_MEMORY, is_missing
from ..plan import PLAN
from .forward import forward_pass, rows_on_tape
from .machine import move_probabilities, read_chain, room_for_moves
from .most_probable_path import most_probable_path

PREDICTED, FILTERED, SMOOTHED, MOST_PROBABLE = range(4)
MOMENTS = {
    "predicted": PREDICTED,
    "filtered": FILTERED,
    "smoothed": SMOOTHED,
    "most probable": MOST_PROBABLE,
}


@njit_internal
def _drawn(weights, u):
    """The number of a state, with probabilities in proportion to weights."""
    total = 0.0
    for i in range(weights.size):
        total += weights[i]
    threshold, last = u * total, 0
    for i in range(weights.size):
        if weights[i] > 0.0:
            last = i
            threshold -= weights[i]
            if threshold < 0.0:
                break
    return last


@njit_internal
def predicted_at_observations(chain, record, tape, known):
    """The probabilities (known, K) of the states just before the first observations."""
    found, place, k = np.empty((known, chain.n_states)), np.int64(0), np.int64(0)
    for j in range(known):
        place += record.steps[j] - k
        k = record.steps[j]
        copy_into(found[j], tape[place])
        place += 0 if is_missing(record.observed, j) else 2
    return found


@njit_internal
def _read_forwards(chain, record, tape, rows, first, end, moment, seed, probabilities, paths):
    """Write the predicted or filtered probabilities at the rows, and independent draws.

    The tape begins at step ``first``, and is known in front of step ``end``.
    """
    place, j, r, steps = np.int64(0), 0, 0, record.steps
    last = min(end, steps[-1] + 1) if steps.size else np.int64(0)
    for k in range(first, last):
        is_seen = j < steps.size and steps[j] == k
        is_informed = is_seen and not is_missing(record.observed, j)
        at = place + 2 if is_informed and moment == FILTERED else place
        if r < rows.size and rows[r] == k:
            for i in range(chain.n_states):
                probabilities[r, i] = tape[at, i]
            paths[r] = _drawn(probabilities[r], uniform_at(seed, STATES, k, 0))
            r += 1
        place += 2 * is_informed + 1
        j += is_seen


@njit_internal
def _read_backwards(chain, record, tape, n_taped, rows, seed, probabilities, paths):
    """Write the smoothed probabilities at the rows, and a path."""
    steps, K = record.steps, chain.n_states
    b, new, weights = np.ones(K), np.empty(K), np.empty(K)
    different, P = room_for_moves(chain)
    if chain.is_invariant:
        move_probabilities(chain, record.inputs, 0, record.t0, different, P)
    place, j, r, drawn = n_taped - 1, steps.size - 1, rows.size - 1, np.int64(0)
    for k in range(steps[-1] if steps.size else 0, -1, -1):
        f = tape[place]
        if k == steps[-1]:
            for i in range(K):
                weights[i] = f[i]
        else:
            if not chain.is_invariant:
                move_probabilities(chain, record.inputs, k, record.t0, different, P)
            for i in range(K):
                new[i] = weights[i] = 0.0
            for m in range(chain.origin.size):
                origin, successor = chain.origin[m], chain.successor[m]
                new[origin] += P[m] * b[successor]
                if successor == drawn:
                    weights[origin] += f[origin] * P[m]
            b, new = new, b
        drawn = _drawn(weights, uniform_at(seed, STATES, k, 0))
        if r >= 0 and rows[r] == k:
            for i in range(K):
                probabilities[r, i] = f[i] * b[i]
            paths[r] = drawn
            r -= 1
        if j >= 0 and steps[j] == k:
            if not is_missing(record.observed, j):
                place -= 2
                for i in range(K):
                    b[i] *= tape[place + 1, i]
            j -= 1
        place -= 1


@njit_internal
def _read_path(chain, record, tape, rows, probabilities, paths):
    """Write the most probable path, whose states have probability one."""
    path = most_probable_path(chain, record, tape)
    for r in range(rows.size):
        if rows[r] >= path.size:
            break
        paths[r] = path[rows[r]]
        probabilities[r, :] = 0.0
        probabilities[r, paths[r]] = 1.0


@njit_internal
def _probabilities(call, rows, moment, paths):
    """The chain, and probabilities (R, K) of its states at the rows: NaN where unknown.

    The filter may go on from earlier rows. What it leaves is written where it is wanted.
    """
    to, J = call.results, call.record[RECORD.n_rows]
    record = single_record(call, 0, 0, J)
    terms = reals_at(to[RESULTS.terms], (J,)) if to[RESULTS.terms] != 0 else np.empty(J)
    health = reals_at(to[RESULTS.health], (HEALTH_SIZE,))
    terms[:] = -np.inf
    health[0], health[1], health[2] = np.inf, OUT_OF_MEMORY, 0.0
    chain = read_chain(call.plan, record.theta, record.inputs)
    probabilities = np.full((rows.size, chain.n_states), np.nan)
    tape = np.empty((rows_on_tape(record.steps), chain.n_states))
    before, after = state_given(call.request), state_wanted(call)
    code, end = forward_pass(chain, record, before, terms, tape)
    health[1], health[2] = code, -1.0
    if code != NONE:
        health[2] = end
        terms[int(end) :] = -np.inf
    if after.size:
        after[:] = np.nan
        if code == NONE and record.steps.size:
            after[0] = record.steps[-1]
            copy_into(after[1:], tape[end - 1])
    seed = call.request[REQUEST.draw_seed]
    if moment == SMOOTHED:
        if code == NONE:
            _read_backwards(chain, record, tape, end, rows, seed, probabilities, paths)
    elif moment == MOST_PROBABLE:
        if code == NONE:
            _read_path(chain, record, tape, rows, probabilities, paths)
    else:
        first, known = np.int64(before[0]) if before.size else 0, first_unknown(call, health)
        _read_forwards(chain, record, tape, rows, first, known, moment, seed, probabilities, paths)
    return chain, probabilities


@njit_internal
def _moments(chain, weights, mean, cov):
    """Write the mean (n,) and the covariance (n, n) of the state; NaN where it is unknown."""
    n = mean.size
    for a in range(n):
        mean[a] = 0.0
        for i in range(weights.size):
            mean[a] += weights[i] * chain.X[a, i]
    for a in range(n):
        for b in range(a + 1):
            total = 0.0
            for i in range(weights.size):
                total += weights[i] * (chain.X[a, i] - mean[a]) * (chain.X[b, i] - mean[b])
            cov[a, b] = cov[b, a] = total


def _states(plan, record, request, results):
    """Moments, and draws or the members of a run, whichever are wanted."""
    status, call = opened(plan, record, request, results)
    if status != OK:
        return status
    n_before = call.request[REQUEST.n_state]
    if n_before != 0 and n_before != call.results[RESULTS.n_state]:
        return np.int64(STATE)
    if call.request[REQUEST.sizes_only]:
        return status
    rows, to, n = wanted_rows(call), call.results, call.plan[PLAN.n]
    paths = np.zeros(rows.size, np.int64)
    chain, found = _probabilities(call, rows, call.plan[PLAN.last_event], paths)
    K = chain.n_states
    n_drawn = rows.size if to[RESULTS.drawn] != 0 else 0
    n_run = rows.size if to[RESULTS.members] != 0 else 0
    mean, sd = reals_at(to[RESULTS.mean], (rows.size, n)), reals_at(to[RESULTS.sd], (n_drawn, n))
    drawn = reals_at(to[RESULTS.drawn], (n_drawn, n))
    n_effective = reals_at(to[RESULTS.n_effective_wanted], (n_drawn,))
    covs = reals_at(to[RESULTS.cov], (n_run, n, n))
    members = reals_at(to[RESULTS.members], (n_run, K, n))
    weights = reals_at(to[RESULTS.weights], (n_run, K))
    cov = np.empty((n, n))
    for r in range(rows.size):
        _moments(chain, found[r], mean[r], cov)
        if n_drawn:
            is_known = not np.isnan(found[r, 0])
            n_effective[r] = np.inf if is_known else np.nan
            for a in range(n):
                sd[r, a] = math.sqrt(cov[a, a])
                drawn[r, a] = chain.X[a, paths[r]] if is_known else np.nan
        if n_run:
            for a in range(n):
                for b in range(n):
                    covs[r, a, b] = cov[a, b]
            for i in range(K):
                weights[r, i] = found[r, i]
                for a in range(n):
                    members[r, i, a] = chain.X[a, i]
    return status


STATES_OF_CHAIN = plan_entry(_states, "markov_chain_states")
