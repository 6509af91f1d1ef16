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
from ..calls import OK, opened, reals_at, single_record, state_given, state_wanted, wanted_rows
from ..outcomes import NONE, OUT_OF_MEMORY, is_missing
from ..plan import log_density, read_system, settings_of
from .forward_pass import ON_GRID, write_outcome
from .grid import gather, grid_points
from .law import drawn_from, is_law, law_before, leave, new_tape
from .moments import PREDICTED, SMOOTHED, Rows, mean_and_sd, total_mass
from .recursion import TOO_SHORT, empty_table, transition_at, with_sources
from .segment_pass import along_record, finished
from .segment_states import smooth_segments
from .tiles import LANES, block_of, multiply


@njit_internal
def _room(address, size):
    """The numbers at an address, or others where none are wanted."""
    return reals_at(address, (size,)) if address != 0 else np.empty(size)


def _grid_states(plan, record, request, results):
    """Moments, and draws or a run, whichever are wanted."""
    status, call = opened(plan, record, request, results)
    if status != OK or call.request[REQUEST.sizes_only]:
        return status
    to, J, before = call.results, call.record[RECORD.n_rows], state_given(call.request)
    data, settings, at = single_record(call, 0, 0, J), settings_of(call.plan), wanted_rows(call)
    if before.size and not (is_law(before) and (J == 0 or before[0] < data.steps[0])):
        return np.int64(STATE)
    tolerance, moment, R = settings[0], int(settings[1]), at.size
    system = read_system(call.plan, data.theta, data.inputs)
    mean, sd = reals_at(to[RESULTS.mean], (R,)), _room(to[RESULTS.sd], R)
    drawn, cov = _room(to[RESULTS.drawn], R), _room(to[RESULTS.cov], R)
    n_effective, terms = _room(to[RESULTS.n_effective_wanted], R), _room(to[RESULTS.terms], J)
    health = reals_at(to[RESULTS.health], (HEALTH_SIZE,))
    # What stays if memory ends.
    mean[:], sd[:], drawn[:], terms[:] = np.nan, np.nan, np.nan, -np.inf
    health[0], health[1], health[2] = np.inf, OUT_OF_MEMORY, 0.0
    rows = Rows(at, call.request[REQUEST.draw_seed], mean, sd, drawn)
    code, j = _evaluate(system, data, before, tolerance, moment, rows, terms, state_wanted(call))
    for i in range(R):
        if code != NONE and (moment == SMOOTHED or j == 0 or at[i] >= data.steps[j]):
            mean[i], sd[i], drawn[i] = np.nan, np.nan, np.nan
        cov[i] = sd[i] * sd[i]
        n_effective[i] = np.nan if np.isnan(mean[i]) else np.inf
    write_outcome(code, j, terms, health)
    return status


@njit_internal
def _evaluate(system, record, before, tolerance, moment, rows, terms, after):
    """Write rows, terms and the state left; return (NONE, J), or (reason, observation)."""
    at, steps = rows.at, record.steps
    if moment == SMOOTHED and rows.at.size:
        at = np.arange(rows.at[0], steps[-1] + 1)
    elif after.size and steps.size and not (rows.at.size and rows.at[-1] == steps[-1]):
        at = np.append(rows.at, steps[-1])
    tape, law = new_tape(at, moment == PREDICTED), law_before(system, before)
    if after.size:
        after[:] = np.nan
    if moment == SMOOTHED and rows.at.size:
        return along_record(system, record, law, False, tolerance, terms, tape, _smooth, rows)
    code, j = along_record(
        system, record, law, after.size > 0, tolerance, terms, tape, finished, rows
    )
    for i in range(min(rows.at.size, len(tape.laws))):
        here, u = tape.laws[i], uniform_at(rows.draw_seed, STATES, rows.at[i], 0)
        rows.mean[i], rows.sd[i] = here.mean, here.sd
        rows.drawn[i] = drawn_from(here, here.parts.mass, u)
    if after.size and code == NONE and len(tape.laws):
        leave(after, tape.laws[-1])
    return code, j


@njit_internal
def _smooth(system, record, settings, tolerance, terms, tape, rows):
    """Write the smoothed rows in a backward pass: (code, observation, floor needed)."""
    if settings.place == ON_GRID:
        code, j = _smooth_grids(system, record, settings, tolerance, terms, tape, rows)
        return code, j, settings.floor
    return smooth_segments(record.steps, settings.floor, tolerance, rows, tape)


@njit_internal
def _smooth_grids(system, record, settings, tolerance, terms, tape, rows):
    """The same on grids: (NONE, J), or (reason, observation)."""
    steps, observed, t0 = record.steps, record.observed, record.t0
    spacing, reach = settings.spacing, settings.reach
    at, table, later = tape.at, empty_table(), tape.laws[-1]
    ratio, drawn = np.ones(later.parts.mass.size), 0.0
    i, j = rows.at.size - 1, steps.size - 1
    for row in range(at.size - 1, -1, -1):
        k, here = at[row], tape.laws[row]
        grid = here.first, here.spacing, here.parts.mass[0]
        low, grid_spacing, mass = grid
        t, weights = t0 + k * system.dt, mass
        if k < at[-1]:
            mean, sd, ratio, table = _predict_adjoint(
                system, k, t, spacing, reach, grid, table, later, ratio
            )
            weights = _backward_weights(mass, mean, sd, drawn)
        smoothed = mass * ratio
        if not _is_contained(smoothed, tolerance):
            return TOO_SHORT, min(j + 1, steps.size - 1)
        u = uniform_at(rows.draw_seed, STATES, k, 0)
        drawn = drawn_from(here, weights.reshape(1, weights.size), u)
        if rows.at[i] == k:
            rows.mean[i], rows.sd[i] = mean_and_sd(low, grid_spacing, smoothed)
            rows.drawn[i] = drawn
            i -= 1
        if j >= 0 and steps[j] == k:
            if not is_missing(observed, j):
                _update_adjoint(system, k, t, observed[j], grid, terms[j], ratio)
            j -= 1
        later = here
    return NONE, steps.size


@njit_internal
def _predict_adjoint(system, k, t, spacing, reach, grid, table, later, ratio):
    """Carry the ratio from the law ``later`` one step back: (mean, sd, ratio, table)."""
    low, _, mass = grid
    tabled, mean, sd, _, table = transition_at(system, k, t, spacing, reach, grid, table)
    if tabled and later.spacing == spacing:
        end = block_of(later.first + ratio.size - 1) + 1
        table = with_sources(table, spacing, reach, block_of(later.first), end)
        first, end = block_of(low), block_of(low + mass.size - 1) + 1
        rows = multiply(table.tiles, later.first, ratio, first, end - first)
        ratio = rows[low - LANES * first : low - LANES * first + mass.size]
    else:
        ratio = gather(later.first, later.spacing, ratio, mean, sd, reach)
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
"""States at chosen steps, and whole runs."""
