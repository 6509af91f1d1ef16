"""States of a Gaussian filter: predicted, filtered, smoothed, and the run.

Predicted and filtered states take one forward pass, smoothed states a backward pass too. The
forward pass leaves a tape with all states: before each step and before each observation.
"""

from functools import lru_cache

import numpy as np

from ...compiler.codegen.function_types import jit
from ...compiler.native.jit import njit_internal
from ...compiler.native.plan import HEALTH_SIZE, RECORD, REQUEST, RESULTS, Plan, plan_entry
from ...compiler.numerics.normals import BLOCK, FILL_NORMALS
from ...compiler.numerics.philox import STATES
from ...compiler.numerics.small_cholesky import covariance_root
from ..calls import OK, opened, reals_at, wanted_rows
from ..outcomes import NONE, OUT_OF_MEMORY, is_missing
from ..plan import PLAN, make_plan, settings_of
from ..protocol import System
from .alone import n_states_on_tape
from .bryson_frazier import BrysonFrazier
from .forward import forward_pass
from .functions import (
    ALONG,
    Functions,
    GaussianFilterFunctions,
    checked,
    compiled,
    extensions,
    places_of,
)
from .group import (
    N_OF_RECORD,
    copy,
    load_parameters,
    parameters_of,
    records_of,
    set_all,
    states_wanted,
    status_of_states,
    table_of,
)
from .linearization import Linearizations
from .machine import call, read_machine, workspace

MOMENTS = {"predicted": 0, "filtered": 1, "smoothed": 2}
_PREDICTED, _, _SMOOTHED = MOMENTS.values()

# Counters of the random stream `STATES`: the steps of the record (one column each), the start.
_ALONG, _AT_START = 0, 1

_NO_COVARIANCE = -1


@lru_cache(maxsize=256)
def _smoother(
    recursion: GaussianFilterFunctions, by: Linearizations
) -> tuple[BrysonFrazier, Functions]:
    """The smoother of a filter, and its functions, used for all moments."""
    smoother = BrysonFrazier(recursion, by)
    n_cov, n_noises = smoother.covariances.values.type.shape[0], smoother.n_noises
    places = places_of(recursion, smoother.size, n_cov, n_noises + recursion.system.p)
    return smoother, compiled(smoother.functions(), places, ALONG, in_lanes=False)


def states_plan(
    system: System, recursion: GaussianFilterFunctions, by: Linearizations, moment: str
) -> Plan:
    """The plan of "predicted", "filtered" or "smoothed" states."""
    smoother, functions = _smoother(recursion, by)
    back = ("predict_back", "update_back", "smooth")
    used = [n for n in functions.entries if n not in back or moment == "smoothed"]
    covs, n_theta = smoother.covariances, recursion.start.inputs["theta"].type.shape[0]
    rows = {name: n_theta + first for name, (first, _) in covs.places.items()}
    noise_cov = rows.get("process_noise", _NO_COVARIANCE) if smoother.draws_q else _NO_COVARIANCE
    return make_plan(
        system, _STATES, (), checked(recursion.system, covs, n_theta),
        **{name: functions.entries[name] for name in used}, **extensions(system),
        state_size=smoother.size, n_lanes=1, n_rows=functions.n_rows,
        n_covariances=covs.values.type.shape[0], n_noises=smoother.n_noises + recursion.system.p,
        initial_cov=rows["initial_cov"], noise_cov=noise_cov, last_event=MOMENTS[moment],
    )  # fmt: skip


@njit_internal
def n_steps_of(table):
    """The step of the last row of a record."""
    return table.rows[-1, 0] if table.rows.shape[0] else np.int64(0)


@njit_internal
def taped_pass(opening, machine, covariances, table, health):
    """Terms, a tape of all states, and the first step without one."""
    records, to = records_of(opening), opening.results
    n_rows, size = opening.record[RECORD.n_rows], machine.size
    terms = reals_at(to[RESULTS.terms], (n_rows,)) if to[RESULTS.terms] else np.empty(n_rows)
    tape = np.empty(n_states_on_tape(machine, table.rows, records) * size)
    n_taped = forward_pass(
        machine, covariances, table, records, tape, terms, health, states_wanted(opening)
    )
    end = n_steps_of(table) + 1
    if health[0, 1] != NONE:
        # Without valid covariances, not even the start is known.
        end = table.rows[int(health[0, 2]), 0] if n_taped else np.int64(0)
    return tape.reshape((tape.size // size, size)), end


@njit_internal
def new_health(to):
    """The health of the record, with what stays if memory ends."""
    health = reals_at(to[RESULTS.health], (1, HEALTH_SIZE))
    health[0, 0], health[0, 1], health[0, 2] = np.inf, OUT_OF_MEMORY, 0.0
    return health


def _states(plan, record, request, results):
    status, opening = opened(plan, record, request, results)
    if status != OK or opening.request[REQUEST.sizes_only]:
        return status
    rows, to, machine = wanted_rows(opening), opening.results, read_machine(opening.plan)
    n_wanted, n = rows.size, machine.n
    mean, sd = room(to[RESULTS.mean], n_wanted, n), room(to[RESULTS.sd], n_wanted, n)
    drawn = room(to[RESULTS.drawn], n_wanted, n)
    n_effective = room(to[RESULTS.n_effective_wanted], n_wanted, 1)
    health = new_health(to)
    without_noise = table_of(opening, parameters_of(opening), np.empty((0, 0)), np.empty(0))
    X, Z = _noise(opening, machine, without_noise)
    table = table_of(opening, without_noise.theta, Z, X)
    tape, end = taped_pass(opening, machine, settings_of(opening.plan), table, health)
    if opening.plan[PLAN.last_event] == _SMOOTHED:
        n_known = _read_backwards(machine, table, tape, end, rows, mean, sd, drawn)
    else:
        is_predicted = opening.plan[PLAN.last_event] == _PREDICTED
        n_known = _read_forwards(n, is_predicted, table, tape, end, rows, mean, sd, drawn)
    set_all(n_effective[:n_known, 0], np.inf)
    return OK


@njit_internal
def _read_forwards(n, is_predicted, table, tape, end, rows, mean, sd, drawn):
    """Write predicted or filtered states at the rows; return how many rows have a state."""
    places, size = places_on_tape(rows, table.rows[:, 0], end, is_predicted), n + n * (n + 1) // 2
    for r in range(places.size):
        s = tape[places[r]]
        read_moments(s, mean[r], sd[r])
        for i in range(n):
            drawn[r, i] = s[i] + s[size + i]
    return places.size


@njit_internal
def places_on_tape(rows, steps, end, is_predicted):
    """Where the tape has the states at rows, those in front of step ``end``."""
    places, n_known, j = np.empty(rows.size, np.int64), 0, 0
    for k in rows:
        if k >= end:
            break
        while j < steps.size and steps[j] < k:
            j += 1
        is_seen = j < steps.size and steps[j] == k
        places[n_known] = k + j + (is_seen and not is_predicted)
        n_known += 1
    return places[:n_known]


@njit_internal
def read_moments(s, mean, sd):
    """Write mean and standard deviations from a state: a mean, and a lower triangle by rows."""
    n = mean.size
    for i in range(n):
        mean[i] = s[i]
        sd[i] = np.sqrt(max(s[n + i * (i + 3) // 2], 0.0))


@njit_internal
def _read_backwards(machine, table, tape, end, rows, mean, sd, drawn):
    """Write smoothed states at the rows; none if the filter failed."""
    m, steps, n, t0 = machine, table.rows[:, 0], machine.n, table.t0
    n_steps = n_steps_of(table)
    if end <= n_steps:
        return 0
    work, records = workspace(m), np.zeros((1, N_OF_RECORD), np.int64)
    W, inputs = work.W, table.inputs
    load_parameters(m, table, records, W)
    call(m.start, m, 1, work, work.states, work.forces, t0, 0, 1)
    moments = W[m.rows.moments :]
    j, r = steps.size - 1, rows.size - 1
    informed = False  # until an observation the adjoint is zero, even if Jacobians are infinite
    for k in range(n_steps, -1, -1):
        if r < 0:
            break
        if k < inputs.shape[0]:
            copy(inputs[k], work.forces[: m.n_inputs])
        copy(table.noises[k], work.forces[m.n_inputs :])
        is_seen = j >= 0 and steps[j] == k
        after = tape[k + j + 1]
        if informed:
            call(m.predict_back, m, 1, work, after, work.forces, t0, k, 1)
        if rows[r] == k:
            call(m.smooth, m, 1, work, after, work.forces, t0, k, 1)
            for i in range(n):
                mean[r, i], drawn[r, i] = moments[i], moments[2 * n + i]
                sd[r, i] = np.sqrt(max(moments[n + i], 0.0))
            r -= 1
        if is_seen:
            if not is_missing(table.observed, j):
                copy(table.observed[j], W[m.rows.d : m.rows.d + m.p])
                call(m.update_back, m, 1, work, tape[k + j], work.forces, t0, k, 1)
                informed = True
            j -= 1
    return rows.size


_fill = FILL_NORMALS.external
_purpose = np.int64(STATES)


@njit_internal
def _noise(opening, machine, table):
    """X (n,) ~ N(0, P_0), and Z (steps, noises).

    If the smoother draws q, the first columns of Z have its covariance. The covariances may be
    singular; where they are none, all is NaN.
    """
    m, plan, seed = machine, opening.plan, opening.request[REQUEST.draw_seed]
    work, records = workspace(m), np.zeros((1, N_OF_RECORD), np.int64)
    load_parameters(m, table, records, work.W)
    call(m.start, m, 1, work, work.states, work.forces, table.t0, 0, 1)
    width = BLOCK * (n_steps_of(table) // BLOCK + 1)  # a column for each step, in whole blocks
    X, Z = np.empty((m.n, BLOCK)), np.empty((m.n_noises, width))
    _fill(seed, _purpose, _AT_START, 0, X.ctypes.data, m.n, BLOCK)
    _fill(seed, _purpose, _ALONG, 0, Z.ctypes.data, m.n_noises, width)
    apply_covariance(work.W, plan[PLAN.initial_cov], m.n, X)
    if plan[PLAN.noise_cov] != _NO_COVARIANCE:
        apply_covariance(work.W, plan[PLAN.noise_cov], m.n_noises - m.p, Z)
    return X[:, 0].copy(), Z.T.copy()


@jit
def apply_covariance(values, first, size, Z):
    """Multiply ``size`` rows of standard normals by the root of the covariance in ``values``."""
    root = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            root[i, j] = values[first + i * size + j]
    covariance_root(root)
    for i in range(size - 1, -1, -1):  # last row first: a row depends on itself and those above
        for member in range(Z.shape[1]):
            total = 0.0
            for j in range(i + 1):
                total += root[i, j] * Z[j, member]
            Z[i, member] = total


_STATES = plan_entry(_states, "gaussian_states", needs=[FILL_NORMALS])


def _run(plan, record, request, results):
    """Write mean and covariance from the tape; without spread, the states of a path as well."""
    status, opening = opened(plan, record, request, results)
    if status != OK:
        return status
    rows, to, machine = wanted_rows(opening), opening.results, read_machine(opening.plan)
    status = status_of_states(opening, machine)
    if status != OK or opening.request[REQUEST.sizes_only]:
        return status
    n, n_wanted = machine.n, rows.size
    mean, cov = room(to[RESULTS.mean], n_wanted, n), room(to[RESULTS.cov], n_wanted, n * n)
    sd, drawn = room(to[RESULTS.sd], n_wanted, n), room(to[RESULTS.drawn], n_wanted, n)
    n_effective = room(to[RESULTS.n_effective_wanted], n_wanted, 1)
    health = new_health(to)
    table = table_of(opening, parameters_of(opening), np.empty((0, 0)), np.empty(0))
    tape, end = taped_pass(opening, machine, settings_of(opening.plan), table, health)
    steps, j = table.rows[:, 0], 0
    for r in range(n_wanted):
        if rows[r] >= end:
            break
        while j < steps.size and steps[j] <= rows[r]:
            j += 1
        s, at = tape[rows[r] - table.first + j], n
        for a in range(n):
            mean[r, a] = drawn[r, a] = s[a]
            sd[r, a] = 0.0
            for b in range(a + 1):
                covariance = 0.0
                if machine.size > n:
                    covariance, at = s[at], at + 1
                cov[r, a * n + b] = cov[r, b * n + a] = covariance
        n_effective[r, 0] = np.inf
    return OK


@njit_internal
def room(address, n_rows, width):
    """A matrix of NaN: at an address, or elsewhere where it is not wanted."""
    room = reals_at(address, (n_rows, width)) if address else np.empty((n_rows, width))
    set_all(room.reshape(room.size), np.nan)
    return room


RUN = plan_entry(_run, "gaussian_run")
