"""The path of states that is the most probable one given all observations.

    d_j at a step = max over the moves i -> j of  log P(move | i) + d_i + log r_i,

where r are the scaled densities of the observations at the step that is left (A. J. Viterbi, IEEE
Transactions on Information Theory 13, 1967).
"""

import math

import numpy as np

from ...compiler.native.jit import njit_internal
from ..outcomes import is_missing
from .machine import move_probabilities, room_for_moves


@njit_internal
def _log(values, out):
    """Write logarithms, minus infinity of zero."""
    for i in range(values.size):
        out[i] = math.log(values[i]) if values[i] > 0.0 else -np.inf


@njit_internal
def _best_moves(chain, log_P, best, new, came_from):
    """Write what each state's best move gives, and the state that it comes from."""
    for i in range(new.size):
        new[i] = -np.inf
    for m in range(log_P.size):
        i, j = chain.origin[m], chain.successor[m]
        value = best[i] + log_P[m]
        if value > new[j]:
            new[j] = value
            came_from[j] = i


@njit_internal
def most_probable_path(chain, record, tape):
    """The numbers of its states at the steps 0 to the last observation, from a forward tape."""
    steps, K = record.steps, chain.n_states
    last = steps[-1] if steps.size else np.int64(0)
    came_from = np.zeros((last + 1, K), np.int32)
    best, new, log_r = np.empty(K), np.empty(K), np.empty(K)
    different, P = room_for_moves(chain)
    log_P = np.empty(P.size)
    if chain.is_invariant:
        move_probabilities(chain, record.inputs, 0, record.t0, different, P)
        _log(P, log_P)
    _log(tape[0], best)
    place, j = np.int64(0), 0
    for k in range(last + 1):
        if j < steps.size and steps[j] == k:
            if not is_missing(record.observed, j):
                _log(tape[place + 1], log_r)
                for i in range(K):
                    best[i] += log_r[i]
                place += 2
            j += 1
        if k < last:
            if not chain.is_invariant:
                move_probabilities(chain, record.inputs, k, record.t0, different, P)
                _log(P, log_P)
            _best_moves(chain, log_P, best, new, came_from[k + 1])
            best, new = new, best
            place += 1
    path = np.empty(last + 1, np.int64)
    path[last] = np.argmax(best)
    for k in range(last, 0, -1):
        path[k - 1] = came_from[k, path[k]]
    return path
