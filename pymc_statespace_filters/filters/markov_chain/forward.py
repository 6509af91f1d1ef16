"""The forward pass: the probabilities of all states along a record.

    predicted a_j   = sum over the moves i -> j of P(move | i) f_i,
    term            = log s,  s = sum_i a_i p(d | i),
    filtered  f_i   = a_i r_i,  r_i = p(d | i) / s

(L. R. Rabiner, "A tutorial on hidden Markov models", Proc. IEEE 77, 1989, with its scaling). A tape
has a row f before each step, two rows a and r for each observation, and a last row f.
"""

import math

import numpy as np

from ...compiler.native.jit import copy_into, inlined_fused, njit_internal
from ...compiler.native.plan import HEALTH_SIZE, RECORD, RESULTS, plan_entry
from ...compiler.numerics.exponential import exp, log
from ..calls import OK, end_of_record, include_health, opened, reals_at, single_record
from ..outcomes import NONE, OBSERVATION_UNDEFINED, OUT_OF_MEMORY, ZERO_DENSITY, is_missing
from ..plan import PLAN
from .machine import (
    call_members,
    move_probabilities,
    n_states_of,
    read_chain,
    room_for_moves,
    start_probabilities,
)

# Below this mean of the densities, those of the likely states are far below that of another one.
_SMALL = 1e-250
# Probabilities have any unit until their sum is beyond these: a division at each observation would
# wait for the one before.
_LEAST_TOTAL, _MOST_TOTAL = 1e-8, 1e8
_MOST = 700.0  # of an exponent

_DENSITIES = 2  # a row behind two of probabilities


@inlined_fused
def _copy_row(tape, place, rows, row, scale):
    """Write a multiple of a row to a tape."""
    for i in range(rows.shape[1]):
        tape[place, i] = scale * rows[row, i]


@inlined_fused
def _predict(origin, first_move, P, f, now, later):
    """Write the probabilities one step later to a row of f."""
    for i in range(f.shape[1]):
        total = 0.0
        for m in range(first_move[i], first_move[i + 1]):
            total += P[m] * f[now, origin[m]]
        f[later, i] = total


@njit_internal
def _rescale(f, now, total):
    """Divide the probabilities by their sum."""
    for i in range(f.shape[1]):
        f[now, i] /= total


@njit_internal
def new_block(chain, n_rows):
    """How many observations are evaluated at once, and arrays: states, data, log-densities.

    Columns of a state are next to each other, one for each observation.
    """
    n, D = chain.emission_X.shape
    n_at_once = max(min(chain.n_at_once, n_rows), 1)
    X = np.empty((n, n_at_once * D))
    for i in range(n):
        for number in range(D):
            for row in range(n_at_once):
                X[i, number * n_at_once + row] = chain.emission_X[i, number]
    return n_at_once, X, np.zeros((chain.p, X.shape[1])), np.empty((1, X.shape[1]))


@njit_internal
def load_block(chain, record, first, n_at_once, Z):
    """Load the observations from row ``first`` on; return step and time of the first."""
    observed, n_rows = record.observed, min(n_at_once, record.steps.size - first)
    for b in range(Z.shape[0]):
        for row in range(n_rows):
            Z[b, row] = observed[first + row, b]
        for at in range(n_at_once, Z.shape[1], n_at_once):
            for row in range(n_rows):
                Z[b, at + row] = Z[b, row]
    k = record.steps[first]
    return k, record.t0 + k * chain.dt


@njit_internal
def _densities(log_p, n_at_once, shifts, E):
    """Write densities over the largest of an observation, whose logarithm is its shift."""
    n_rows = min(n_at_once, shifts.size)
    shifts[:n_rows] = -np.inf
    for at in range(0, E.size, n_at_once):
        for row in range(n_rows):
            value = log_p[0, at + row]
            shifts[row] = value if value > shifts[row] else shifts[row]  # NaN is not
    for at in range(0, E.size, n_at_once):
        for row in range(n_rows):
            E[at + row] = log_p[0, at + row] - shifts[row]
    for i in range(E.size):
        E[i] = exp(E[i])


@inlined_fused
def _weigh(first, E, row, f, now):
    """Write densities of an observation, and f times these to the other row; return their sum.

    The densities are those ``row`` places behind the ``first`` one of each state.
    """
    s = 0.0
    for i in range(first.size):
        f[_DENSITIES, i] = E[first[i] + row]
        f[1 - now, i] = f[now, i] * f[_DENSITIES, i]
        s += f[1 - now, i]
    return s


@njit_internal
def _weigh_by_logs(first, log_p, row, f, now):
    """The same with densities over the largest of a possible state, and the log of that."""
    largest, s = -np.inf, 0.0
    for i in range(first.size):
        value = log_p[0, first[i] + row]
        if f[now, i] > 0.0 and value > largest:
            largest = value
    for i in range(first.size):
        value = log_p[0, first[i] + row]
        f[_DENSITIES, i] = 0.0
        if largest > -np.inf and value > -np.inf:
            f[_DENSITIES, i] = math.exp(min(value - largest, _MOST))
        f[1 - now, i] = f[now, i] * f[_DENSITIES, i]
        s += f[1 - now, i]
    return s, largest


@njit_internal
def _why(first, log_p, row, f, now):
    """Why an observation has no density at the possible states."""
    for i in range(first.size):
        if f[now, i] > 0.0 and log_p[0, first[i] + row] == -np.inf:
            return np.int64(ZERO_DENSITY)
    return np.int64(OBSERVATION_UNDEFINED)


@njit_internal
def forward_pass(chain, record, before, terms, tape):
    """Write terms and the tape: (NONE, its rows), or (a reason, the failing observation).

    ``before`` is the state from which the filter goes on, a step and probabilities, or empty.
    """
    shifts = np.zeros(terms.size)
    code, end = _along(chain, record, before, terms, shifts, tape)
    for j in range(terms.size if code == NONE else end):
        terms[j] = shifts[j] + log(terms[j])
    return code, end


@njit_internal
def _along(chain, record, before, means, shifts, tape):
    """The same with the mean of an observation's densities, and the log of its unit.

    Arrays are taken out of their tuples before the loop, and no part of one is taken in it: both
    would count references there. ``total`` is the sum of the probabilities f.
    """
    steps, observed, inputs = record.steps, record.observed, record.inputs
    origin, first_move = chain.origin, chain.first_move
    f, now, total = np.empty((3, chain.n_states)), 0, 1.0
    different, P = room_for_moves(chain)
    n_at_once, X, Z, log_p = new_block(chain, steps.size)
    E, is_taped = np.empty(X.shape[1]), tape.shape[0] > 0
    first = chain.emission_number * n_at_once
    if chain.failure != NONE:
        return np.int64(chain.failure), np.int64(0)
    k, code = np.int64(0), np.int64(NONE)
    if before.size:
        k = np.int64(before[0])
        copy_into(f[0], before[1:])
    else:
        code = start_probabilities(chain, inputs, f[0])
    if code == NONE and chain.is_invariant:
        code = move_probabilities(chain, inputs, 0, record.t0, different, P)
    if code != NONE:
        return code, np.int64(0)
    place, row = np.int64(0), n_at_once
    for j in range(steps.size):
        while k < steps[j]:
            if not chain.is_invariant:
                code = move_probabilities(chain, inputs, k, record.t0, different, P)
                if code != NONE:
                    return code, np.int64(j)
            if is_taped:
                _copy_row(tape, place, f, now, 1.0 / total)
            _predict(origin, first_move, P, f, now, 1 - now)
            now = 1 - now
            place += 1
            k += 1
        if row == n_at_once:
            at, t = load_block(chain, record, j, n_at_once, Z)
            call_members(chain.emission, chain.c, inputs, at, t, Z, X, log_p)
            _densities(log_p, n_at_once, shifts[j:], E)
            row = 0
        if is_missing(observed, j):
            means[j], shifts[j] = 1.0, 0.0
        else:
            s = _weigh(first, E, row, f, now)
            is_usual = s > _LEAST_TOTAL and s < _MOST_TOTAL
            if not is_usual and not (s > _SMALL * total and s < np.inf):
                s, shifts[j] = _weigh_by_logs(first, log_p, row, f, now)
                if not (s > 0.0 and s < np.inf):
                    return _why(first, log_p, row, f, now), np.int64(j)
            means[j] = s / total
            if is_taped:
                _copy_row(tape, place, f, now, 1.0 / total)
                _copy_row(tape, place + 1, f, _DENSITIES, total / s)
            now, total = 1 - now, s
            place += 2
            if not is_usual:
                _rescale(f, now, s)
                total = 1.0
        row += 1
    if is_taped:
        _copy_row(tape, place, f, now, 1.0 / total)
    return np.int64(NONE), place + 1


@njit_internal
def rows_on_tape(steps):
    """The most rows on the tape of a record."""
    return (steps[-1] if steps.size else np.int64(0)) + 2 * steps.size + 1


@njit_internal
def _record_of(call, number, first):
    """The record that begins in a row, and the row behind it."""
    last = end_of_record(call, first)
    return single_record(call, number, first, last), last


@njit_internal
def rows_of_tapes(call):
    """The most rows on the tapes of all records."""
    total, first = np.int64(0), np.int64(0)
    for number in range(call.record[RECORD.n_records]):
        record, last = _record_of(call, number, first)
        total += rows_on_tape(record.steps)
        first = last if call.record[RECORD.row_width] > 1 else first
    return total


@njit_internal
def all_records(call, terms, healths, tape):
    """The forward pass of all records, or of all points; return how many rows the tape has."""
    is_panel, n_rows = call.record[RECORD.row_width] > 1, call.record[RECORD.n_rows]
    first, place = np.int64(0), np.int64(0)
    for number in range(call.record[RECORD.n_records]):
        record, last = _record_of(call, number, first)
        begin = first if is_panel else number * n_rows
        own = terms[begin : begin + record.steps.size]
        own[:] = -np.inf
        chain = read_chain(call.plan, record.theta, record.inputs)
        code, end = forward_pass(chain, record, np.empty(0), own, tape[place:])
        health = np.empty(HEALTH_SIZE) if is_panel else healths[number]
        health[0], health[1], health[2] = np.inf, code, -1.0
        if code != NONE:
            health[2] = end
            own[int(end) :] = -np.inf
        elif tape.shape[0] > 0:
            place += end
        if is_panel:
            include_health(healths[0], health, first)
            first = last
    return place


def _forward(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    if status != OK:
        return status
    to, n_states = call.results, n_states_of(call.plan)
    if call.plan[PLAN.leaves_tape]:
        to[RESULTS.n_tape], to[RESULTS.tape_width] = rows_of_tapes(call), n_states
    if call.request[0]:
        return status
    n_points = to[RESULTS.n_points]
    terms = reals_at(to[RESULTS.terms], (n_points * call.record[RECORD.n_rows],))
    healths = reals_at(to[RESULTS.health], (n_points, HEALTH_SIZE))
    for i in range(n_points):  # what stays if memory ends
        healths[i, 0], healths[i, 1], healths[i, 2] = np.inf, OUT_OF_MEMORY, 0.0
    if call.record[RECORD.row_width] > 1:
        healths[0, 1], healths[0, 2] = NONE, -1.0
    n_tape = to[RESULTS.n_tape] if to[RESULTS.tape] else 0
    tape = reals_at(to[RESULTS.tape], (n_tape, n_states))
    n_taped = all_records(call, terms, healths, tape)
    if n_tape:
        to[RESULTS.n_tape] = n_taped if healths[0, 1] == NONE else 0
    return status


FORWARD = plan_entry(_forward, "markov_chain_forward")
