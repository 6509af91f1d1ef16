"""States of a Rao-Blackwellised particle filter, the mixture of its particles.

Smoothed states are those of paths drawn back, see `backward_simulation`.
"""

import numpy as np
from numba import carray

from ...compiler.native.entry_point import EntryPoint
from ...compiler.native.jit import copy_into, njit_internal
from ...compiler.native.plan import HEALTH_SIZE, RECORD, REQUEST, RESULTS, plan_entry
from ..calls import ALL_STEPS, OK, first_unknown, opened, reals_at, single_record, wanted_rows
from ..ensemble.backward_simulation import n_paths_of
from ..ensemble.callbacks import CALLBACK_ARGUMENTS, run_observed, searchsorted
from ..ensemble.loop import N_LEADING
from ..ensemble.summaries import finite_weights, write_summaries
from ..ensemble.weights import effective_number
from ..outcomes import NONE
from ..plan import PLAN, read_system, settings_of
from .backward_simulation import Mixtures, simulate_backward
from .moments import draw_of_mixture, mixture_moments

# Those of the resampling, in front of the numbers of finite states and of draws, and the order.
N_SETTINGS = 2

# Integers of the callback, then the steps of the rows, then the order of the states.
_N_HEADER = 14
(
    _N, _PARTICLES, _ROWS, _LAST_EVENT, _SEED, _NEXT, _FINITE, _ORDER, _MEAN, _COV, _DRAWN,
    _EFFECTIVE, _STATES, _WEIGHTS,
) = range(_N_HEADER)  # fmt: skip


def _summarise(integers, reals, event, j, k, X, log_w, d, D, ancestors):
    header = carray(integers, (_N_HEADER,))
    if event > header[_LAST_EVENT]:  # particles before resampling say the same, more exactly
        return
    n_rows, n = header[_ROWS], header[_ORDER]
    whole = carray(integers, (_N_HEADER + n_rows + n,))
    rows, order = whole[_N_HEADER : _N_HEADER + n_rows], whole[_N_HEADER + n_rows :]
    row = header[_NEXT] = searchsorted(rows, k, header[_NEXT])
    if row == rows.size or rows[row] != k:
        return
    particles = carray(X, (header[_N], header[_PARTICLES]))
    w = finite_weights(particles, carray(log_w, (header[_PARTICLES],)))
    if w.any():
        _write_row(header, row, k, order, particles, w)


@njit_internal
def _write_row(header, row, k, order, particles, w):
    """Write what is wanted of a row; addresses of other things are 0."""
    n, N, n_rows, n_finite = order.size, w.size, header[_ROWS], header[_FINITE]
    n_effective = effective_number(w)
    cov = reals_at(header[_COV], (n_rows, n, n))[row]
    mean = reals_at(header[_MEAN], (n_rows, n))[row]
    mixture_moments(w, particles, n_finite, order, 1.0 - 1.0 / n_effective, mean, cov)
    if header[_DRAWN] != 0:
        drawn = reals_at(header[_DRAWN], (n_rows, n))[row]
        draw_of_mixture(w, particles, n_finite, order, header[_SEED], k, drawn)
        reals_at(header[_EFFECTIVE], (n_rows,))[row] = n_effective
    else:
        states = reals_at(header[_STATES], (n_rows, N, n))[row]
        for i in range(N):
            for a in range(n):
                states[i, a] = particles[order[a], i]
        copy_into(reals_at(header[_WEIGHTS], (n_rows, N))[row], w)


SUMMARISE_MIXTURE = EntryPoint(_summarise, CALLBACK_ARGUMENTS, "summarise_mixture")


@njit_internal
def _header(call, order, n_finite):
    """The integers of the callback."""
    rows, plan = wanted_rows(call), call.plan
    integers = np.zeros(_N_HEADER + rows.size + order.size, np.int64)
    integers[_N], integers[_PARTICLES] = plan[PLAN.n], plan[PLAN.n_members]
    integers[_ROWS], integers[_LAST_EVENT] = rows.size, plan[PLAN.last_event]
    integers[_SEED], integers[_NEXT] = call.request[REQUEST.draw_seed], 0
    integers[_FINITE], integers[_ORDER] = n_finite, order.size
    copy_into(integers[_N_HEADER : _N_HEADER + rows.size], rows)
    for a in range(order.size):
        integers[_N_HEADER + rows.size + a] = order[a]
    return integers


@njit_internal
def _order(call):
    """The number of finite states, and where each state is among these and the others."""
    given = settings_of(call.plan)[N_LEADING + N_SETTINGS :]
    call.results[RESULTS.n_states] = given.size - 2
    return np.int64(given[0]), given[2:].astype(np.int64)


@njit_internal
def _n_draws(plan):
    """How many draws of the finite variables a step has."""
    return np.int64(settings_of(plan)[N_LEADING + N_SETTINGS + 1])


@njit_internal
def _fill(numbers, value):
    for i in range(numbers.size):
        numbers[i] = value


def _states(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    if status != OK:
        return status
    n_finite, order = _order(call)
    if call.request[REQUEST.sizes_only]:
        return status
    to, n, n_rows = call.results, order.size, wanted_rows(call).size
    integers, cov = _header(call, order, n_finite), np.full(n_rows * n * n, np.nan)
    integers[_MEAN], integers[_COV], integers[_DRAWN] = (
        to[RESULTS.mean],
        cov.ctypes.data,
        to[RESULTS.drawn],
    )
    integers[_EFFECTIVE] = to[RESULTS.n_effective_wanted]
    mean, drawn = reals_at(to[RESULTS.mean], (n_rows, n)), reals_at(to[RESULTS.drawn], (n_rows, n))
    n_effective = reals_at(to[RESULTS.n_effective_wanted], (n_rows,))
    _fill(mean.reshape(n_rows * n), np.nan)
    _fill(drawn.reshape(n_rows * n), np.nan)
    _fill(n_effective, np.nan)
    status, _, health = run_observed(call, plan, record, integers, np.empty(0))
    sd, until = reals_at(to[RESULTS.sd], (n_rows, n)), first_unknown(call, health)
    for row, step in enumerate(wanted_rows(call)):
        for a in range(n):
            if step >= until:
                mean[row, a] = drawn[row, a] = cov[(row * n + a) * n + a] = np.nan
            sd[row, a] = np.sqrt(max(cov[(row * n + a) * n + a], 0.0))
            if np.isnan(mean[row, a]):
                sd[row, a] = np.nan
        if step >= until:
            n_effective[row] = np.nan
    copy_into(reals_at(to[RESULTS.health], (HEALTH_SIZE,)), health)
    return status


def _run(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    if status != OK:
        return status
    n_finite, order = _order(call)
    if call.request[REQUEST.sizes_only]:
        return status
    to, n, n_rows = call.results, order.size, wanted_rows(call).size
    N, integers = call.plan[PLAN.n_members], _header(call, order, n_finite)
    integers[_MEAN], integers[_COV] = to[RESULTS.mean], to[RESULTS.cov]
    integers[_STATES], integers[_WEIGHTS] = to[RESULTS.members], to[RESULTS.weights]
    mean, cov = reals_at(to[RESULTS.mean], (n_rows, n)), reals_at(to[RESULTS.cov], (n_rows, n * n))
    members = reals_at(to[RESULTS.members], (n_rows, N * n))
    weights = reals_at(to[RESULTS.weights], (n_rows, N))
    for row in range(n_rows):
        _forget(row, mean, cov, members, weights)
    status, terms, health = run_observed(call, plan, record, integers, np.empty(0))
    until = first_unknown(call, health)
    for row, step in enumerate(wanted_rows(call)):
        if step >= until:
            _forget(row, mean, cov, members, weights)
    copy_into(reals_at(to[RESULTS.terms], (terms.size,)), terms)
    copy_into(reals_at(to[RESULTS.health], (HEALTH_SIZE,)), health)
    return status


@njit_internal
def _forget(row, mean, cov, members, weights):
    _fill(mean[row], np.nan)
    _fill(cov[row], np.nan)
    _fill(members[row], np.nan)
    _fill(weights[row], np.nan)


def _smooth(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    if status != OK:
        return status
    n_finite, order = _order(call)
    if call.request[REQUEST.sizes_only]:
        return status
    rows, n, N = wanted_rows(call), call.plan[PLAN.n], call.plan[PLAN.n_members]
    data = single_record(call, 0, 0, call.record[RECORD.n_rows])
    n_steps = data.steps[-1] if data.steps.size else np.int64(0)
    integers, stored = np.array([n, N]), np.empty((n_steps + 1) * (n + 1) * N)
    reals = np.full((3 * order.size + 1) * rows.size, np.nan)
    status, _, health = run_observed(call, plan, record, integers, stored)
    is_known = health[1] == NONE
    if is_known:
        system = read_system(call.plan, data.theta, data.inputs)
        mixtures = Mixtures(
            stored=stored.reshape((n_steps + 1, n + 1, N)), n_finite=n_finite, order=order,
            moves=call.plan[PLAN.moves], n_draws=_n_draws(call.plan), c=system.c,
            inputs=system.inputs, t0=data.t0, dt=system.dt,
        )  # fmt: skip
        simulate_backward(mixtures, n_paths_of(N), call.request[REQUEST.draw_seed], rows, reals)
    write_summaries(call, reals, health, ALL_STEPS if is_known else 0)
    return status


STATES_OF_MIXTURE = plan_entry(_states, "rbpf_states")
"""Predicted or filtered states, in one pass."""

RUN_OF_MIXTURE = plan_entry(_run, "rbpf_run")
"""One run that keeps all particles at some steps, with the means of their Kalman filters."""

SMOOTH_MIXTURE = plan_entry(_smooth, "rbpf_smoother")
"""Smoothed states, by paths drawn back through the particles of all steps."""
