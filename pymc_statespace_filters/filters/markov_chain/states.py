"""States given the observations: probabilities of all states at chosen steps, and paths drawn.

The smoothed probabilities are the filtered ones times what the later observations say,

    b_i at a step = sum over the moves i -> j of P(move | i) r_j b_j of the next one, without r_j
    where nothing is observed,

and a path is drawn from the last step back, from f_i P(i -> the state drawn after it).
"""

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
from ..ensemble.part_moments import choose
from ..ensemble.summaries import forget, write_row
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
def read_forwards(chain, record, tape, rows, first, end, is_filtered, probabilities):
    """Write the predicted or filtered probabilities at the rows; return how many rows are known.

    The tape begins at step ``first``, and is known in front of step ``end``.
    """
    place, j, r, steps = np.int64(0), 0, 0, record.steps
    last = min(end, steps[-1] + 1) if steps.size else np.int64(0)
    for k in range(first, last):
        is_seen = j < steps.size and steps[j] == k
        is_informed = is_seen and not is_missing(record.observed, j)
        if r < rows.size and rows[r] == k:
            copy_into(probabilities[r], tape[place + 2 * (is_informed and is_filtered)])
            r += 1
        place += 2 * is_informed + 1
        j += is_seen
    return r


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
        drawn = choose(weights, uniform_at(seed, STATES, k, 0) * weights.sum())
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
def _read_path(chain, record, tape, rows, probabilities):
    """Write the most probable path, whose states have probability one."""
    path = most_probable_path(chain, record, tape)
    for r in range(rows.size):
        probabilities[r, path[rows[r]]] = 1.0


@njit_internal
def _probabilities(call, chain, record, rows, moment, paths):
    """Probabilities (R, K) of the states at the rows, and how many of them are known.

    The filter may go on from earlier rows. What it leaves is written where it is wanted.
    """
    to, J = call.results, call.record[RECORD.n_rows]
    terms = reals_at(to[RESULTS.terms], (J,)) if to[RESULTS.terms] != 0 else np.empty(J)
    health = reals_at(to[RESULTS.health], (HEALTH_SIZE,))
    terms[:] = -np.inf
    health[0], health[1], health[2] = np.inf, OUT_OF_MEMORY, 0.0
    found = np.zeros((rows.size, chain.n_states))
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
    if moment == PREDICTED or moment == FILTERED:
        first, known = np.int64(before[0]) if before.size else 0, first_unknown(call, health)
        is_filtered = moment == FILTERED
        return found, read_forwards(chain, record, tape, rows, first, known, is_filtered, found)
    if code != NONE:
        return found, 0
    if moment == SMOOTHED:
        seed = call.request[REQUEST.draw_seed]
        _read_backwards(chain, record, tape, end, rows, seed, found, paths)
    else:
        _read_path(chain, record, tape, rows, found)
    return found, rows.size


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
    order, moment, paths = np.arange(n), call.plan[PLAN.last_event], np.zeros(rows.size, np.int64)
    data = single_record(call, 0, 0, call.record[RECORD.n_rows])
    forget(call, n, 0)
    chain = read_chain(call.plan, data.theta, data.inputs)
    found, known = _probabilities(call, chain, data, rows, moment, paths)
    seed, drawn = call.request[REQUEST.draw_seed], to[RESULTS.drawn]
    for r in range(known):
        write_row(to, r, rows[r], n, order, chain.X, found[r], np.inf, seed)
        if drawn != 0 and moment == SMOOTHED:
            copy_into(reals_at(drawn, (rows.size, n))[r], chain.X[:, paths[r]])
    return status


STATES_OF_CHAIN = plan_entry(_states, "markov_chain_states")
