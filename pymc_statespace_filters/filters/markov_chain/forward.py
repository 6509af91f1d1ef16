"""The forward pass: the probabilities of all states along a record.

    predicted a_j   = sum over the moves i -> j of P(move | i) f_i,
    term            = log s,  s = sum_i a_i p(d | i),
    filtered  f_i   = a_i r_i,  r_i = p(d | i) / s

(L. R. Rabiner, "A tutorial on hidden Markov models", Proc. IEEE 77, 1989, with its scaling). A tape
has a row f before each step, two rows a and r for each observation, and a last row f.
"""

import math

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.native.plan import HEALTH_SIZE, RECORD, RESULTS, plan_entry
from ...compiler.numerics.exponential import exp, log
from ..calls import OK, end_of_record, include_health, opened, reals_at, single_record
from ..outcomes import NONE, OBSERVATION_UNDEFINED, OUT_OF_MEMORY, ZERO_DENSITY, is_missing
from ..plan import PLAN
from .machine import (
    call_members,
    move_probabilities,
    read_chain,
    room_for_moves,
    start_probabilities,
)

# Below, the states that have a probability have densities much smaller than another state.
_SMALL = 1e-250
_MOST = 700.0  # of an exponent


@njit_internal
def _copy_row(tape, place, rows, row):
    """Write a row of a tape; nothing if there is none."""
    if tape.shape[0] > 0:
        for i in range(rows.shape[1]):
            tape[place, i] = rows[row, i]


@njit_internal
def _predict(origin, first_move, P, f, now, later):
    """Write the probabilities one step later to a row of f."""
    for i in range(f.shape[1]):
        total = 0.0
        for m in range(first_move[i], first_move[i + 1]):
            total += P[m] * f[now, origin[m]]
        f[later, i] = total


@njit_internal
def new_block(chain, n_rows):
    """How many observations are evaluated at once, and arrays: states, data, log-densities."""
    n, D = chain.emission_X.shape
    n_at_once = max(min(chain.n_at_once, n_rows), 1)
    size = n_at_once * D
    X = np.empty((n, size))
    for i in range(n):
        for row in range(n_at_once):
            for number in range(D):
                X[i, row * D + number] = chain.emission_X[i, number]
    return n_at_once, X, np.zeros((chain.p, size)), np.empty((1, size))


@njit_internal
def load_block(chain, record, first, n_at_once, Z):
    """Load the observations from row ``first`` on; return step and time of the first."""
    D = chain.emission_X.shape[1]
    for row in range(first, min(first + n_at_once, record.steps.size)):
        for b in range(Z.shape[0]):
            value = record.observed[row, b]
            for number in range((row - first) * D, (row - first + 1) * D):
                Z[b, number] = value
    k = record.steps[first]
    return k, record.t0 + k * chain.dt


@njit_internal
def _densities(log_p, D, shifts, E):
    """Write densities over the largest of an observation, whose logarithm is its shift."""
    for row in range(shifts.size):
        largest = -np.inf
        for number in range(row * D, (row + 1) * D):
            value = log_p[0, number]
            largest = value if value > largest else largest  # NaN is not
        shifts[row] = largest
        for number in range(row * D, (row + 1) * D):
            E[number] = log_p[0, number] - largest
    for number in range(E.size):
        E[number] = exp(E[number])


@njit_internal
def _update(number, E, log_p, first, shift, f, before, after, r):
    """Write r and a row of f; return s and the logarithm of its unit. s is NaN without a density.

    The densities of the observation are those from ``first`` on.
    """
    s = 0.0
    for i in range(number.size):
        s += f[before, i] * E[first + number[i]]
    if s > _SMALL and s < np.inf:
        scale = 1.0 / s
        for i in range(number.size):
            r[0, i] = scale * E[first + number[i]]
            f[after, i] = f[before, i] * r[0, i]
        return s, shift
    s, shift = _update_by_logs(number, log_p, first, f, before, r)
    if not (s > 0.0 and s < np.inf):
        return np.nan, shift
    for i in range(number.size):
        r[0, i] /= s
        f[after, i] = f[before, i] * r[0, i]
    return s, shift


@njit_internal
def _update_by_logs(number, log_p, first, f, before, r):
    """Write densities over the largest of a possible state; return their mean, and its log."""
    largest, s = -np.inf, 0.0
    for i in range(number.size):
        value = log_p[0, first + number[i]]
        if f[before, i] > 0.0 and value > largest:
            largest = value
    for i in range(number.size):
        value = log_p[0, first + number[i]]
        r[0, i] = 0.0
        if largest > -np.inf and value > -np.inf:
            r[0, i] = math.exp(min(value - largest, _MOST))
            s += f[before, i] * r[0, i]
    return s, largest


@njit_internal
def _why(number, log_p, first, f, before):
    """Why an observation has no density at the possible states."""
    for i in range(number.size):
        if f[before, i] > 0.0 and log_p[0, first + number[i]] == -np.inf:
            return np.int64(ZERO_DENSITY)
    return np.int64(OBSERVATION_UNDEFINED)


@njit_internal
def forward_pass(chain, record, terms, tape):
    """Write terms and the tape: (NONE, its rows), or (a reason, the failing observation)."""
    shifts = np.zeros(terms.size)
    code, end = _along(chain, record, terms, shifts, tape)
    for j in range(terms.size if code == NONE else end):
        terms[j] = shifts[j] + log(terms[j])
    return code, end


@njit_internal
def _along(chain, record, means, shifts, tape):
    """The same with the mean s of an observation's densities, and the log of its unit.

    Arrays are taken out of their tuples before the loop, and no part of one is taken in it: both
    would count references there.
    """
    steps, observed, inputs = record.steps, record.observed, record.inputs
    origin, first_move, number = chain.origin, chain.first_move, chain.emission_number
    f, r, now = np.empty((2, chain.n_states)), np.empty((1, chain.n_states)), 0
    different, P = room_for_moves(chain)
    n_at_once, X, Z, log_p = new_block(chain, steps.size)
    D, E, shift_of_row = X.shape[1] // n_at_once, np.empty(X.shape[1]), np.empty(n_at_once)
    if chain.failure != NONE:
        return np.int64(chain.failure), np.int64(0)
    code = start_probabilities(chain, inputs, f[0])
    if code == NONE and chain.is_invariant:
        code = move_probabilities(chain, inputs, 0, record.t0, different, P)
    if code != NONE:
        return code, np.int64(0)
    k, place, row = np.int64(0), np.int64(0), n_at_once
    for j in range(steps.size):
        while k < steps[j]:
            if not chain.is_invariant:
                code = move_probabilities(chain, inputs, k, record.t0, different, P)
                if code != NONE:
                    return code, np.int64(j)
            _copy_row(tape, place, f, now)
            _predict(origin, first_move, P, f, now, 1 - now)
            now = 1 - now
            place += 1
            k += 1
        if row == n_at_once:
            at, t = load_block(chain, record, j, n_at_once, Z)
            call_members(chain.emission, chain.c, inputs, at, t, Z, X, log_p)
            _densities(log_p, D, shift_of_row, E)
            row = 0
        if is_missing(observed, j):
            means[j] = 1.0
        else:
            first = row * D
            s, shift = _update(number, E, log_p, first, shift_of_row[row], f, now, 1 - now, r)
            if np.isnan(s):
                return _why(number, log_p, first, f, now), np.int64(j)
            means[j], shifts[j] = s, shift
            _copy_row(tape, place, f, now)
            _copy_row(tape, place + 1, r, 0)
            now = 1 - now
            place += 2
        row += 1
    _copy_row(tape, place, f, now)
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
        code, end = forward_pass(chain, record, own, tape[place:])
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
    to, n_states = call.results, call.plan[PLAN.state_size]
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
