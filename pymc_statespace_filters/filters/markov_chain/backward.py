"""The backward pass along the tape of the forward pass: the derivative of the terms.

With the cotangents g of a term, b of the filtered probabilities f, and w = sum_i b_i f_i,

    of a_i:  r_i (g + b_i - w),    of log p(d | i):  f_i (g + b_i - w),
    of f_i:  sum over the moves i -> j of P(move | i) b_j,    of P(move | i):  f_i b_j.

Those of probabilities are finite where a probability is zero.
"""

import numpy as np

from ...compiler.native.entry_point import call_address
from ...compiler.native.jit import copy_into, njit_internal
from ...compiler.native.plan import HEALTH_SIZE, RECORD, REQUEST, RESULTS, plan_entry
from ..calls import OK, end_of_record, opened, reals_at, single_record
from ..outcomes import NONE, is_missing
from ..plan import NULL, PLAN
from .forward import all_records, load_block, new_block, rows_of_tapes
from .machine import call_members, move_probabilities, n_states_of, read_chain, room_for_moves


@njit_internal
def _add(rows, derivatives, weights, theta_bar):
    """Add weighted sums of derivatives; one without a weight may be infinite."""
    for i in range(rows.size):
        total = 0.0
        for number in range(weights.size):
            if weights[number] != 0.0:
                total += derivatives[i, number] * weights[number]
        theta_bar[rows[i]] += total


@njit_internal
def _back_to_moves(chain, inputs, k, t0, P_bar, theta_bar):
    """Add what the probabilities of the moves of a step contribute."""
    if chain.move_rows.size:
        derivatives = np.empty((chain.move_rows.size, P_bar.size))
        t = t0 + k * chain.dt
        call_members(
            chain.move_back, chain.c, inputs, k, t, chain.move_V, chain.move_X, derivatives
        )
        _add(chain.move_rows, derivatives, P_bar, theta_bar)
    P_bar[:] = 0.0


@njit_internal
def _back_to_start(chain, inputs, b, theta_bar):
    """Add what the probabilities of the starts contribute."""
    if chain.start_rows.size:
        S = chain.start_state.size
        derivatives, bars = np.empty((chain.start_rows.size, S)), np.empty(S)
        for i in range(S):
            bars[i] = b[chain.start_state[i]]
        X = np.zeros((chain.X.shape[0], S))
        call_members(chain.start_back, chain.c, inputs, NULL, 0.0, chain.start_V, X, derivatives)
        _add(chain.start_rows, derivatives, bars, theta_bar)


@njit_internal
def _predict_back(chain, P, f, b, new, P_bar):
    """Write the cotangent of f, and add those of the moves."""
    for i in range(new.size):
        new[i] = 0.0
    for m in range(P.size):
        origin, later = chain.origin[m], b[chain.successor[m]]
        new[origin] += P[m] * later
        P_bar[chain.move_number[m]] += f[origin] * later


@njit_internal
def backward_pass(chain, record, tape, end, terms_bar, theta_bar):
    """Add the derivative of one record, whose rows on the tape end before ``end``; their first."""
    steps, K = record.steps, chain.n_states
    b, new = np.zeros(K), np.empty(K)
    different, P = room_for_moves(chain)
    P_bar = np.zeros(different.size)
    n_at_once, X, Z, _ = new_block(chain, steps.size)
    weights = np.zeros(X.shape[1])
    derivatives = np.empty((max(chain.emission_rows.size, 1), weights.size))
    if chain.is_invariant:
        move_probabilities(chain, record.inputs, 0, record.t0, different, P)
    place = end - 1  # behind it is the last f
    for j in range(steps.size - 1, -1, -1):
        row = j % n_at_once
        if not is_missing(record.observed, j):
            place -= 2
            a, r, w = tape[place], tape[place + 1], 0.0
            for i in range(K):
                w += b[i] * a[i] * r[i]
            for i in range(K):
                bar = r[i] * (terms_bar[j] + b[i] - w)
                weights[chain.emission_number[i] * n_at_once + row] += a[i] * bar
                b[i] = bar
        if row == 0 and chain.emission_rows.size:
            k, t = load_block(chain, record, j, n_at_once, Z)
            call_members(chain.emission_back, chain.c, record.inputs, k, t, Z, X, derivatives)
            _add(chain.emission_rows, derivatives, weights, theta_bar)
            weights[:] = 0.0
        for k in range(steps[j] - 1, (steps[j - 1] if j else 0) - 1, -1):
            if not chain.is_invariant:
                move_probabilities(chain, record.inputs, k, record.t0, different, P)
            place -= 1
            _predict_back(chain, P, tape[place], b, new, P_bar)
            b, new = new, b
            if not chain.is_invariant:
                _back_to_moves(chain, record.inputs, k, record.t0, P_bar, theta_bar)
    if chain.is_invariant:
        _back_to_moves(chain, record.inputs, 0, record.t0, P_bar, theta_bar)
    _back_to_start(chain, record.inputs, b, theta_bar)
    return place


@njit_internal
def _tape_of(call, n_states):
    """The tape that a call brings, or that of a forward pass; empty if this fails."""
    request = call.request
    if not call.plan[PLAN.leaves_tape]:
        return reals_at(request[REQUEST.tape], (request[REQUEST.n_tape], n_states))
    given = call.record
    tape = np.empty((rows_of_tapes(call), n_states))
    n_points = call.results[RESULTS.n_points]
    terms, healths = np.empty(n_points * given[RECORD.n_rows]), np.empty((n_points, HEALTH_SIZE))
    for i in range(n_points):
        healths[i, 0], healths[i, 1], healths[i, 2] = np.inf, NONE, -1.0
    n_taped = all_records(call, terms, healths, tape)
    for i in range(n_points):
        if healths[i, 1] != NONE:
            return tape[:0]
    return tape[:n_taped]


def _backward(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    if status != OK or call.request[REQUEST.sizes_only]:
        return status
    given, n_theta = call.record, call.plan[PLAN.n_theta]
    n_records, is_panel = given[RECORD.n_records], given[RECORD.row_width] > 1
    theta_bar = reals_at(call.results[RESULTS.theta_bar], (n_records, given[RECORD.n_theta]))
    theta_bar[:] = 0.0
    tape = _tape_of(call, n_states_of(call.plan))
    if tape.shape[0] == 0:
        return OK
    terms_bar = reals_at(call.request[REQUEST.terms_bar], (call.request[REQUEST.n_terms_bar],))
    firsts = np.zeros(n_records, np.int64)
    for number in range(1, n_records):
        firsts[number] = end_of_record(call, firsts[number - 1]) if is_panel else 0
    place = np.int64(tape.shape[0])
    for number in range(n_records - 1, -1, -1):
        first = firsts[number]
        data = single_record(call, number, first, end_of_record(call, first))
        begin = first if is_panel else number * given[RECORD.n_rows]
        chain, bar = read_chain(call.plan, data.theta, data.inputs), np.zeros(n_theta)
        place = backward_pass(chain, data, tape, place, terms_bar[begin:], bar)
        if call.plan[PLAN.extend_back] == 0:
            copy_into(theta_bar[number], bar)
        elif bar.any():
            size = np.int64(data.theta.size + bar.size)
            both = np.empty(size)
            copy_into(both, data.theta)
            copy_into(both[data.theta.size :], bar)
            call_address(call.plan[PLAN.extend_back], (both, size, theta_bar[number]))
    return OK


BACKWARD = plan_entry(_backward, "markov_chain_backward")
