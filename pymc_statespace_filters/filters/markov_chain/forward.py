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
from ...compiler.numerics.exponential import exp
from ..calls import OK, end_of_record, include_health, opened, reals_at, single_record
from ..outcomes import NONE, OBSERVATION_UNDEFINED, OUT_OF_MEMORY, ZERO_DENSITY, is_missing
from ..plan import PLAN
from .machine import call_members, move_probabilities, read_chain, start_probabilities

# Below, the states that have a probability have densities much smaller than another state.
_SMALL = 1e-250
_MOST = 700.0  # of an exponent


@njit_internal
def copy_row(tape, row, values):
    """Write a row of a tape; nothing if there is none."""
    if tape.shape[0] > 0:
        for i in range(values.size):
            tape[row, i] = values[i]


@njit_internal
def predict(chain, P, f, a):
    """Write the probabilities one step later."""
    for i in range(a.size):
        a[i] = 0.0
    for m in range(chain.origin.size):
        a[chain.successor[m]] += P[0, chain.move_number[m]] * f[chain.origin[m]]


@njit_internal
def new_block(chain):
    """Arrays of observations that are evaluated at once: states, data, log-densities."""
    n, D = chain.emission_X.shape
    size = chain.n_at_once * D
    X = np.empty((n, size))
    for i in range(n):
        for number in range(size):
            X[i, number] = chain.emission_X[i, number % D]
    return X, np.zeros((chain.p, size)), np.empty((1, size))


@njit_internal
def load_block(chain, record, first, Z):
    """Load the observations from row ``first`` on; return step and time of the first."""
    D = chain.emission_X.shape[1]
    for row in range(first, min(first + chain.n_at_once, record.steps.size)):
        for b in range(Z.shape[0]):
            for number in range((row - first) * D, (row - first + 1) * D):
                Z[b, number] = record.observed[row, b]
    k = record.steps[first]
    return k, record.t0 + k * chain.dt


@njit_internal
def _densities(log_p, D, shifts, E):
    """Write densities over the largest of an observation, whose logarithm is its shift."""
    for row in range(shifts.size):
        largest = -np.inf
        for number in range(row * D, (row + 1) * D):
            largest = max(largest, log_p[0, number])  # NaN is not larger
        shifts[row] = largest
        for number in range(row * D, (row + 1) * D):
            E[number] = log_p[0, number] - largest
    for number in range(E.size):
        E[number] = exp(E[number])


@njit_internal
def _update(chain, E, shift, log_p, a, r, f):
    """Write r and f, and return the term; NaN if the observation has no density."""
    s = 0.0
    for i in range(a.size):
        r[i] = E[chain.emission_number[i]]
        s += a[i] * r[i]
    if not (s > _SMALL and s < np.inf):
        s, shift = _update_by_logs(chain, log_p, a, r)
        if not (s > 0.0 and s < np.inf):
            return np.nan
    scale = 1.0 / s
    for i in range(a.size):
        r[i] *= scale
        f[i] = a[i] * r[i]
    return shift + math.log(s)


@njit_internal
def _update_by_logs(chain, log_p, a, r):
    """Write densities over the largest of a possible state; return their mean, and its log."""
    largest, s = -np.inf, 0.0
    for i in range(a.size):
        value = log_p[chain.emission_number[i]]
        if a[i] > 0.0 and value > largest:
            largest = value
    for i in range(a.size):
        value = log_p[chain.emission_number[i]]
        r[i] = 0.0
        if largest > -np.inf and value > -np.inf:
            r[i] = math.exp(min(value - largest, _MOST))
            s += a[i] * r[i]
    return s, largest


@njit_internal
def _why(chain, log_p, a):
    """Why an observation has no density at the possible states."""
    for i in range(a.size):
        if a[i] > 0.0 and log_p[chain.emission_number[i]] == -np.inf:
            return np.int64(ZERO_DENSITY)
    return np.int64(OBSERVATION_UNDEFINED)


@njit_internal
def forward_pass(chain, record, terms, tape):
    """Write terms and the tape: (NONE, its rows), or (a reason, the failing observation)."""
    steps, K, D = record.steps, chain.n_states, chain.emission_X.shape[1]
    a, f, r, P = np.empty(K), np.empty(K), np.empty(K), np.empty((1, chain.move_X.shape[1]))
    X, Z, log_p = new_block(chain)
    shifts, E = np.empty(chain.n_at_once), np.empty(log_p.size)
    if chain.failure != NONE:
        return np.int64(chain.failure), np.int64(0)
    code = start_probabilities(chain, record.inputs, f)
    if code == NONE and chain.is_invariant:
        code = move_probabilities(chain, record.inputs, 0, record.t0, P)
    if code != NONE:
        return code, np.int64(0)
    k, place, block = np.int64(0), np.int64(0), np.int64(0)
    for j in range(steps.size):
        while k < steps[j]:
            if not chain.is_invariant:
                code = move_probabilities(chain, record.inputs, k, record.t0, P)
                if code != NONE:
                    return code, np.int64(j)
            copy_row(tape, place, f)
            predict(chain, P, f, a)
            a, f = f, a
            place += 1
            k += 1
        if j == block:
            at, t = load_block(chain, record, j, Z)
            call_members(chain.emission, chain.c, record.inputs, at, t, Z, X, log_p)
            _densities(log_p, D, shifts, E)
            block += chain.n_at_once
        if is_missing(record.observed, j):
            terms[j] = 0.0
            continue
        a, f = f, a
        row = (chain.n_at_once - (block - j)) * D
        logs = log_p[0, row : row + D]
        term = _update(
            chain, E[row : row + D], shifts[chain.n_at_once - (block - j)], logs, a, r, f
        )
        if not np.isfinite(term):
            return _why(chain, logs, a), np.int64(j)
        terms[j] = term
        copy_row(tape, place, a)
        copy_row(tape, place + 1, r)
        place += 2
    copy_row(tape, place, f)
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
