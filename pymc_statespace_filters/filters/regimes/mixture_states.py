"""States of the filter of merged regimes: its moments, and draws of regime and other states."""

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.native.plan import REQUEST, RESULTS, Plan, plan_entry
from ..calls import OK, opened, wanted_rows
from ..gaussian.functions import (
    GaussianFilterFunctions,
    checked,
    covariances_at,
    extensions,
    forward_functions,
)
from ..gaussian.group import parameters_of, set_all, table_of
from ..gaussian.machine import read_machine
from ..gaussian.states import (
    MOMENTS,
    new_health,
    places_on_tape,
    read_moments,
    room,
    taped_pass,
)
from ..plan import PLAN, make_plan, settings_of
from ..protocol import System
from .hybrid import Hybrid
from .moments import draw_of_mixture

_N_HEADER = 3  # the number of settings of covariances, of finite states, and of regimes


def states_plan(
    system: System, hybrid: Hybrid, recursion: GaussianFilterFunctions, moment: str
) -> Plan:
    """The plan of "predicted" or "filtered" states."""
    functions, theta = forward_functions(recursion, in_lanes=False), recursion.start.inputs["theta"]
    covs = covariances_at(recursion.system, theta)
    checks = checked(recursion.system, covs, theta.type.shape[0])
    n_regimes, n_finite = hybrid.regimes.shape
    settings = (
        len(checks), n_finite, n_regimes, *checks, *hybrid.order, *hybrid.regimes.ravel()
    )  # fmt: skip
    return make_plan(
        system, _STATES, (), settings, **functions.entries, **extensions(system),
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


def _states(plan, record, request, results):
    status, opening = opened(plan, record, request, results)
    if status != OK or opening.request[REQUEST.sizes_only]:
        return status
    rows, to, machine = wanted_rows(opening), opening.results, read_machine(opening.plan)
    n_wanted, n, given = rows.size, machine.n, settings_of(opening.plan)
    n_checks, n_finite, K = int(given[0]), int(given[1]), int(given[2])
    first = _N_HEADER + n_checks
    order = np.empty(n, np.int64)
    for a in range(n):
        order[a] = int(given[first + a])
    regimes = given[first + n :].copy().reshape((K, n_finite))
    mean, sd = room(to[RESULTS.mean], n_wanted, n), room(to[RESULTS.sd], n_wanted, n)
    drawn = room(to[RESULTS.drawn], n_wanted, n)
    n_effective = room(to[RESULTS.n_effective_wanted], n_wanted, 1)
    health, seed = new_health(to), opening.request[REQUEST.draw_seed]
    table = table_of(opening, parameters_of(opening), np.empty((0, 0)), np.empty(0))
    tape, end = taped_pass(opening, machine, given[_N_HEADER:first], table, health)
    is_predicted = opening.plan[PLAN.last_event] == 0
    places = places_on_tape(rows, table.rows[:, 0], end, is_predicted)
    for r in range(places.size):
        s = tape[places[r]]
        read_moments(s, mean[r], sd[r])
        w, X = _parts(s, n, n_finite, regimes)
        draw_of_mixture(w, X, n_finite, order, seed, rows[r], drawn[r])
        set_all(n_effective[r], np.inf)
    return OK


_STATES = plan_entry(_states, "mixture_states")
