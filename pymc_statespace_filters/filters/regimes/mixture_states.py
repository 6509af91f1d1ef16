"""States of the filter of merged regimes: its moments, and draws of regime and other states.

Smoothed states are those of paths drawn back, see `backward_simulation`.
"""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import copy_into, njit_internal
from ...compiler.native.plan import REQUEST, RESULTS, Plan, plan_entry
from ..calls import OK, opened, reals_at, wanted_rows
from ..ensemble.summaries import forget, write_row
from ..gaussian.functions import (
    GaussianFilterFunctions,
    checked,
    covariances_at,
    extensions,
    forward_functions,
)
from ..gaussian.group import parameters_of, set_all, table_of
from ..gaussian.linearization import Linearization
from ..gaussian.machine import read_machine
from ..gaussian.states import (
    MOMENTS,
    n_steps_of,
    new_health,
    places_on_tape,
    taped_pass,
)
from ..plan import PLAN, make_plan, settings_of
from ..protocol import System
from .backward_simulation import Mixtures, simulate_backward
from .hybrid import Hybrid
from .moves import moves_of_parts

# The number of settings of covariances, of finite states, of regimes, and of draws in a step.
_N_HEADER = 4

N_PATHS = 128
"""Paths of which smoothed states are the mean."""


def states_plan(
    system: System,
    hybrid: Hybrid,
    linearization: Linearization,
    recursion: GaussianFilterFunctions,
    moment: str,
) -> Plan:
    """The plan of "predicted", "filtered" or "smoothed" states."""
    functions, theta = forward_functions(recursion, in_lanes=False), recursion.start.inputs["theta"]
    covs = covariances_at(recursion.system, theta)
    checks = checked(recursion.system, covs, theta.type.shape[0])
    n_regimes, n_finite = hybrid.regimes.shape
    settings = (
        len(checks), n_finite, n_regimes, len(hybrid.drawn), *checks, *hybrid.order,
        *hybrid.regimes.ravel(),
    )  # fmt: skip
    entries = {**functions.entries, **extensions(system)}
    if moment == "smoothed":
        entries["moves"] = moves_of_parts(hybrid.system, linearization).entry
    return make_plan(
        system, _SMOOTHED if moment == "smoothed" else _STATES, (), settings, **entries,
        state_size=recursion.size, n_lanes=1, n_rows=functions.n_rows,
        n_covariances=covs.values.type.shape[0], last_event=MOMENTS[moment],
    )  # fmt: skip


@njit_internal
def _parts(s, n, n_finite, regimes):
    """Probabilities and columns of the regimes, see `moments`, from the vector of the filter."""
    K, n_normal = regimes.shape[0], n - n_finite
    size, first = n_normal + n_normal * (n_normal + 1) // 2, n + n * (n + 1) // 2
    w, X = s[first : first + K].copy(), np.empty((n_finite + size, K))
    for r in range(K):
        for a in range(n_finite):
            X[a, r] = regimes[r, a]
        for i in range(size):
            X[n_finite + i, r] = s[first + K + r * size + i]
    return w, X


class _Settings(NamedTuple):
    """The settings of a plan; ``order`` and ``regimes`` as in `Hybrid`."""

    checks: np.ndarray
    n_finite: int
    n_draws: int
    order: np.ndarray
    regimes: np.ndarray


@njit_internal
def _settings(plan):
    given, n = settings_of(plan), plan[PLAN.n]
    n_checks, n_finite, K = int(given[0]), int(given[1]), int(given[2])
    first = _N_HEADER + n_checks
    order = np.empty(n, np.int64)
    for a in range(n):
        order[a] = int(given[first + a])
    return _Settings(
        checks=given[_N_HEADER:first], n_finite=n_finite, n_draws=int(given[3]), order=order,
        regimes=given[first + n :].copy().reshape((K, n_finite)),
    )  # fmt: skip


def _states(plan, record, request, results):
    status, opening = opened(plan, record, request, results)
    if status != OK or opening.request[REQUEST.sizes_only]:
        return status
    rows, to, machine = wanted_rows(opening), opening.results, read_machine(opening.plan)
    n, given, seed = machine.n, _settings(opening.plan), opening.request[REQUEST.draw_seed]
    forget(opening, n, 0)
    table = table_of(opening, parameters_of(opening), np.empty((0, 0)), np.empty(0))
    tape, end = taped_pass(opening, machine, given.checks, table, new_health(to))
    is_predicted = opening.plan[PLAN.last_event] == 0
    places = places_on_tape(rows, table.rows[:, 0], end, is_predicted)
    for r in range(places.size):
        w, X = _parts(tape[places[r]], n, given.n_finite, given.regimes)
        write_row(to, r, rows[r], given.n_finite, given.order, X, w, np.inf, seed)
    return OK


@njit_internal
def _stored(tape, table, given, n):
    """The mixtures of all steps, from the tape of a record that did not fail."""
    steps = np.arange(n_steps_of(table) + 1)
    places = places_on_tape(steps, table.rows[:, 0], steps.size, False)
    _, X = _parts(tape[0], n, given.n_finite, given.regimes)
    stored = np.empty((steps.size, X.shape[0] + 1, X.shape[1]))
    for k in range(steps.size):
        w, X = _parts(tape[places[k]], n, given.n_finite, given.regimes)
        for i in range(X.shape[0]):
            copy_into(stored[k, i], X[i])
        for r in range(w.size):
            stored[k, -1, r] = math.log(w[r])
    return stored


def _smoothed(plan, record, request, results):
    status, opening = opened(plan, record, request, results)
    if status != OK or opening.request[REQUEST.sizes_only]:
        return status
    rows, machine, given = wanted_rows(opening), read_machine(opening.plan), _settings(opening.plan)
    n, to = machine.n, opening.results
    table = table_of(opening, parameters_of(opening), np.empty((0, 0)), np.empty(0))
    tape, end = taped_pass(opening, machine, given.checks, table, new_health(to))
    forget(opening, n, 0)
    if end > n_steps_of(table):
        mixtures = Mixtures(
            stored=_stored(tape, table, given, n), n_finite=given.n_finite, order=given.order,
            moves=opening.plan[PLAN.moves], n_draws=given.n_draws, c=table.theta[0],
            inputs=table.inputs, t0=table.t0, dt=machine.dt,
        )  # fmt: skip
        simulate_backward(mixtures, N_PATHS, opening.request[REQUEST.draw_seed], rows, to)
        set_all(reals_at(to[RESULTS.n_effective_wanted], (rows.size,)), N_PATHS)
    return OK


_STATES = plan_entry(_states, "mixture_states")
_SMOOTHED = plan_entry(_smoothed, "mixture_smoother")
