"""Why an update of a Gaussian filter failed: found out by updates by other observations.

Each component alone, observed as zero, has a finite term unless the observation is not defined at
the state; all of them as zero together do unless the covariance of the observation is not definite;
else it is the observation itself that lies too far out.
"""

import numpy as np

from ...compiler.native.jit import njit_internal
from ..outcomes import (
    COVARIANCE_NOT_POSITIVE,
    LARGEST,
    OBSERVATION_UNDEFINED,
    SINGULAR,
    STATE_NOT_FINITE,
    ZERO_DENSITY,
)
from .group import N_OF_RECORD, N_ROWS, Table, call_along, copy, step_at
from .machine import Work, call, rows_at


@njit_internal
def failure_along(machine, W, table, row, s, term):
    """Why the row of a record alone has this term, which is not finite, at the state s."""
    m, k = machine, step_at(table.rows, row)
    trials = _trials(table.observed[row])
    taken = np.empty(trials.shape[0], np.bool_)
    record, states, no_term = np.zeros(N_OF_RECORD, np.int64), np.zeros(2 * m.size), np.empty(1)
    record[N_ROWS] = 1
    for i in range(taken.size):
        trial = Table(
            rows=table.rows[row : row + 1], theta=table.theta, observed=trials[i : i + 1],
            inputs=table.inputs, noises=table.noises, x=table.x, t0=table.t0, first=k,
            before=table.before,
        )  # fmt: skip
        copy(s, states[: m.size])
        taken[i] = call_along(m.along, m, W, trial, record, states, np.int64(0), no_term) == 1
    return _failure(m, s[: m.size], term, taken)


@njit_internal
def failure_in_lane(machine, work, n_lanes, lane, states, force, t0, k, d, term):
    """Why an observation has this term, which is not finite, in one of several lanes."""
    m, trials = machine, _trials(d)
    taken = np.empty(trials.shape[0], np.bool_)
    size = m.size * m.width
    for i in range(taken.size):
        trial = Work(work.W.copy(), np.zeros(2 * size), work.forces)
        copy(states, trial.states[:size])
        tried = rows_at(m, trial.W, m.rows.d, m.p)
        for b in range(m.p):
            tried[b * m.width + lane] = trials[i, b]
        call(m.update, m, n_lanes, trial, trial.states, force, t0, k, 1)
        taken[i] = np.isfinite(rows_at(m, trial.W, m.rows.term, 1)[lane])
    s = np.empty(m.size)
    for i in range(m.size):
        s[i] = states[i * m.width + lane]
    return _failure(m, s, term, taken)


@njit_internal
def _trials(d):
    """Zero for every component of d that was seen: each alone, then all."""
    p = d.size
    trials = np.empty((p + 1, p))
    for i in range(p):
        for row in range(p + 1):
            trials[row, i] = 0.0 * d[i] if row in (i, p) else np.nan
    return trials


@njit_internal
def _failure(machine, s, term, taken):
    """The reason, from the state, its term, and which trials had a finite one."""
    n = machine.n
    has_cov = machine.size > n
    for i in range(n + (n * (n + 1) // 2 if has_cov else 0)):
        if not abs(s[i]) < LARGEST:
            return STATE_NOT_FINITE
    for i in range(n if has_cov else 0):
        if s[n + i * (i + 3) // 2] < 0.0:
            return COVARIANCE_NOT_POSITIVE
    if not machine.has_gaussian_observation:
        return OBSERVATION_UNDEFINED if np.isnan(term) else ZERO_DENSITY
    for is_taken in taken[:-1]:
        if not is_taken:
            return OBSERVATION_UNDEFINED
    return ZERO_DENSITY if taken[-1] else SINGULAR
