"""States of the point-mass filter: moments of the state at chosen steps, and draws.

The forward pass leaves its grids, with masses of p(x_k | d_1 .. d_k), on a tape. For smoothing the
ratio

    b_k(x_k) = p(x_k | D) / p(x_k | d_1 .. d_k)
             = integral of N(x_{k+1}; g(x_k, 0), s(x_k)^2) p(d_{k+1} | x_{k+1}) b_{k+1}(x_{k+1})
               dx_{k+1} / p(d_{k+1} | d_1 .. d_k),

runs backward from the last observation, where it is one, on the same points and with the same
kernels; steps without an observation have no factor of p(d | x) (G. Kitagawa, "Non-Gaussian
state-space modeling of nonstationary time series", JASA 82, 1987). A trajectory is drawn backward
too, from p(x_k | x_{k+1}, d_1 .. d_k): the masses times the kernel at the x_{k+1} drawn before,
without the ratio.
"""

import math

import numpy as np

from ...compiler.native.jit import inline_always, njit_internal
from ...compiler.native.plan import HEALTH_SIZE, RECORD, REQUEST, RESULTS, STATE, plan_entry
from ...compiler.numerics.philox import STATES, uniform_at
from ...compiler.numerics.restricted_domain import exp
from ..calls import (
    ALL_STEPS,
    OK,
    integers_at,
    opened,
    reals_at,
    single_record,
    state_given,
    state_wanted,
    wanted_rows,
)
from ..outcomes import GRID_TOO_LARGE, NONE, OUT_OF_MEMORY, is_missing
from ..plan import log_density, read_system, settings_of
from .forward_pass import (
    END,
    ON_SEGMENTS,
    attempt,
    first_attempt,
    next_attempt,
    write_outcome,
)
from .grid import gather, grid_points
from .law import is_law, law_before, leave_grid
from .moments import PREDICTED, SMOOTHED, Rows, draw, mean_and_sd, total_mass
from .recursion import TOO_SHORT, empty_table, transition_at, with_sources
from .segment_states import states_on_segments
from .tiles import LANES, block_of, multiply


@njit_internal
def _write_moments(call, rows, drawn):
    """Write mean and deviation of the state at rows, and terms; (code, failing observation)."""
    to, J = call.results, call.record[RECORD.n_rows]
    data, settings = single_record(call, 0, 0, J), settings_of(call.plan)
    tolerance, moment = settings[0], int(settings[1])
    system = read_system(call.plan, data.theta, data.inputs)
    mean = reals_at(to[RESULTS.mean], (rows.size,))
    sd = reals_at(to[RESULTS.sd], (rows.size,)) if to[RESULTS.sd] != 0 else np.empty(rows.size)
    terms = reals_at(to[RESULTS.terms], (J,)) if to[RESULTS.terms] != 0 else np.empty(J)
    health = reals_at(to[RESULTS.health], (HEALTH_SIZE,))
    # What stays if memory ends.
    mean[:], sd[:], drawn[:], terms[:] = np.nan, np.nan, np.nan, -np.inf
    health[0], health[1], health[2] = np.inf, OUT_OF_MEMORY, 0.0
    wanted = Rows(rows, call.request[REQUEST.draw_seed], mean, sd, drawn)
    code, j = _evaluate(call, system, data, tolerance, moment, wanted, terms)
    for i in range(rows.size):
        if code != NONE and (moment == SMOOTHED or j == 0 or rows[i] >= data.steps[j]):
            mean[i], sd[i], drawn[i] = np.nan, np.nan, np.nan
    write_outcome(code, j, terms, health)
    return sd


def _grid_states(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    if status != OK or call.request[REQUEST.sizes_only]:
        return status
    rows = wanted_rows(call)
    _write_moments(call, rows, reals_at(call.results[RESULTS.drawn], (rows.size,)))
    mean = reals_at(call.results[RESULTS.mean], (rows.size,))
    n_effective = reals_at(call.results[RESULTS.n_effective_wanted], (rows.size,))
    for i in range(rows.size):
        n_effective[i] = np.nan if np.isnan(mean[i]) else np.inf
    return status


@njit_internal
def _first_step(call):
    """The step of the first row."""
    return integers_at(call.record[RECORD.rows], 1)[0] if call.record[RECORD.n_rows] else ALL_STEPS


def _grid_run(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    if status != OK or call.request[REQUEST.sizes_only]:
        return status
    before = state_given(call.request)
    if before.size and not (is_law(before) and before[0] < _first_step(call)):
        return np.int64(STATE)
    rows = wanted_rows(call)
    sd = _write_moments(call, rows, np.empty(rows.size))
    cov = reals_at(call.results[RESULTS.cov], (rows.size,))
    for i in range(rows.size):
        cov[i] = sd[i] * sd[i]
    return status


@njit_internal
def _evaluate(call, system, record, tolerance, moment, rows, terms):
    """Write rows, terms and the state left; return (NONE, J), or (reason, observation)."""
    before, after = state_given(call.request), state_wanted(call)
    if after.size:
        after[:] = np.nan
    if system.failure != NONE:
        return np.int64(system.failure), np.int64(0)
    stored, steps = rows.at, record.steps
    if moment == SMOOTHED and rows.at.size:
        stored = np.arange(rows.at[0], steps[-1] + 1)
    elif after.size and steps.size and not (rows.at.size and rows.at[-1] == steps[-1]):
        stored = np.append(rows.at, steps[-1])
    law, is_wide = law_before(system, before), after.size > 0
    place, settings = first_attempt(system, record, law, tolerance, is_wide)
    while place != END:
        if place == ON_SEGMENTS:
            code, j = states_on_segments(
                system, record, law, is_wide, tolerance, moment, rows, stored, terms, after
            )
        else:
            code, j = _states_on_grid(
                system, record, law, settings, tolerance, moment, rows, stored, terms, after
            )
        place, settings = next_attempt(place, code, settings)
        if place == END and code == GRID_TOO_LARGE and is_wide:
            is_wide = False
            place, settings = first_attempt(system, record, law, tolerance, is_wide)
    return code, j


@njit_internal
def _states_on_grid(system, record, law, settings, tolerance, moment, rows, stored, terms, after):
    """One attempt: write rows and terms; return (NONE, J), or (reason, observation) of a stop."""
    grids = [(np.int64(0), 1.0, terms)]  # lets numba infer the type of the empty list
    grids.clear()
    tape = grids, stored, moment
    code, j = attempt(system, record, law, settings, tolerance, terms, _keep, tape)
    if moment != SMOOTHED:
        _write_rows(rows, grids)
        if after.size and code == NONE and grids:
            leave_grid(after, stored[-1], grids[-1])
    elif code == NONE and rows.at.size:
        code, j = _smooth(system, record, settings, tolerance, terms, tape, rows)
    return code, j


@njit_internal
def _keep(tape, k, grid, updated):
    """Append the grid of a stored step to the tape; an updated grid replaces the predicted one."""
    grids, stored, moment = tape
    n = len(grids)
    low, spacing, mass = grid
    if not updated:
        if n < stored.size and stored[n] == k:
            grids.append((low, spacing, mass.copy()))  # the next step may change the masses
    elif moment != PREDICTED and n > 0 and stored[n - 1] == k:
        grids[n - 1] = low, spacing, mass.copy()


@njit_internal
def _write_rows(rows, grids):
    """Write moments and a draw of each grid; rows that were not reached are NaN."""
    for i in range(rows.at.size):
        rows.mean[i], rows.sd[i], rows.drawn[i] = np.nan, np.nan, np.nan
        if i < len(grids):
            low, spacing, mass = grids[i]
            rows.mean[i], rows.sd[i] = mean_and_sd(low, spacing, mass)
            u = uniform_at(rows.draw_seed, STATES, rows.at[i], 0)
            rows.drawn[i] = draw(low, spacing, mass, u)


@njit_internal
def _smooth(system, record, settings, tolerance, terms, tape, rows):
    """Write the smoothed rows in a backward pass; return (NONE, J), or (reason, observation)."""
    steps, observed, t0 = record.steps, record.observed, record.t0
    spacing, reach, _, _ = settings
    grids, stored, _ = tape
    table, later = empty_table(), grids[-1]
    weights, ratio = later[2], np.ones(later[2].size)
    drawn = 0.0
    i, j = rows.at.size - 1, steps.size - 1
    for row in range(stored.size - 1, -1, -1):
        k, grid = stored[row], grids[row]
        low, grid_spacing, mass = grid
        t = t0 + k * system.dt
        if k < stored[-1]:
            mean, sd, ratio, table = _predict_adjoint(
                system, k, t, spacing, reach, grid, table, later, ratio
            )
            weights = _backward_weights(mass, mean, sd, drawn)
        smoothed = mass * ratio
        if not _is_contained(smoothed, tolerance):
            return TOO_SHORT, min(j + 1, steps.size - 1)
        drawn = draw(low, grid_spacing, weights, uniform_at(rows.draw_seed, STATES, k, 0))
        if rows.at[i] == k:
            rows.mean[i], rows.sd[i] = mean_and_sd(low, grid_spacing, smoothed)
            rows.drawn[i] = drawn
            i -= 1
        if j >= 0 and steps[j] == k:
            if not is_missing(observed, j):
                _update_adjoint(system, k, t, observed[j], grid, terms[j], ratio)
            j -= 1
        later = grid
    return NONE, steps.size


@njit_internal
def _predict_adjoint(system, k, t, spacing, reach, grid, table, later, ratio):
    """Carry the ratio from the grid ``later`` one step back: (mean, sd, ratio, table)."""
    low, _, mass = grid
    tabled, mean, sd, _, table = transition_at(system, k, t, spacing, reach, grid, table)
    if tabled and later[1] == spacing:
        end = block_of(later[0] + ratio.size - 1) + 1
        table = with_sources(table, spacing, reach, block_of(later[0]), end)
        first, end = block_of(low), block_of(low + mass.size - 1) + 1
        rows = multiply(table.tiles, later[0], ratio, first, end - first)
        ratio = rows[low - LANES * first : low - LANES * first + mass.size]
    else:
        ratio = gather(later[0], later[1], ratio, mean, sd, reach)
    return mean, sd, ratio, table


@njit_internal
def _backward_weights(mass, mean, sd, x):
    """Masses times the densities of the state x one step later."""
    out = np.empty(mass.size)
    for i in range(mass.size):
        precision = 1.0 / sd[i]
        z = (x - mean[i]) * precision
        weight = mass[i] * precision * exp(-0.5 * z * z)
        out[i] = weight if weight > 0.0 else 0.0  # a diverged point gives NaN
    return out


@inline_always
def _is_contained(smoothed, tolerance):
    """Whether the smoothed density has mass, and none of it is lost beyond the ends of the grid."""
    total = total_mass(smoothed)
    if not (total > 0.0 and total < np.inf):
        return False
    return smoothed.size == 1 or smoothed[0] + smoothed[-1] <= tolerance * total


@njit_internal
def _update_adjoint(system, k, t, d, grid, term, ratio):
    """Multiply the ratio by p(d | x) / p(d | d_1 ..), in place; zero at points without mass."""
    low, spacing, mass = grid
    log_likelihood = np.empty(mass.size)
    log_density(system, k, t, d, grid_points(low, mass.size, spacing), log_likelihood)
    for i in range(mass.size):
        is_possible = mass[i] > 0.0 and log_likelihood[i] < np.inf
        ratio[i] *= math.exp(log_likelihood[i] - term) if is_possible else 0.0


GRID_STATES = plan_entry(_grid_states, "grid_states")
GRID_RUN = plan_entry(_grid_run, "grid_run")
