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
from numba import carray, types

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction
from pymc_statespace_filters.compiler.native.cache_key import digest, key_of
from pymc_statespace_filters.compiler.native.entry_point import (
    F64_PTR,
    I64_PTR,
    EntryPoint,
    arguments_class,
)
from pymc_statespace_filters.compiler.native.jit import (
    inline_always,
    keep_alive,
    njit_callable,
    njit_internal,
)
from pymc_statespace_filters.compiler.numerics.philox import STATES, uniform_at
from pymc_statespace_filters.compiler.numerics.restricted_domain import exp
from pymc_statespace_filters.filters.outcomes import (
    COVARIANCE_NOT_POSITIVE,
    NONE,
    OUT_OF_MEMORY,
    TOO_FAR,
    is_missing,
)
from pymc_statespace_filters.filters.point_mass.forward_pass import (
    END,
    ON_GRID,
    ON_SEGMENTS,
    attempt,
    first_grid,
    next_attempt,
)
from pymc_statespace_filters.filters.point_mass.grid import gather, grid_points
from pymc_statespace_filters.filters.point_mass.moments import draw, mean_and_sd, total_mass
from pymc_statespace_filters.filters.point_mass.recursion import (
    TOO_SHORT,
    empty_table,
    has_valid_covariances,
    transition_at,
    with_sources,
)
from pymc_statespace_filters.filters.point_mass.rows import (
    FILTERED,
    MOMENTS,
    PREDICTED,
    SMOOTHED,
    Rows,
)
from pymc_statespace_filters.filters.point_mass.segment_states import states_on_segments
from pymc_statespace_filters.filters.point_mass.tiles import LANES, block_of, multiply
from pymc_statespace_filters.filters.protocol import RunFunction, StatesFunction, System
from pymc_statespace_filters.filters.system_table import (
    SYSTEM_ARGUMENTS,
    log_density,
    read_system,
    system_table,
)

STATES_ARGUMENTS = SYSTEM_ARGUMENTS | {
    "tolerance": types.float64, "moment": types.intp,
    "steps": I64_PTR, "n_observations": types.intp, "observed": F64_PTR, "t0": types.float64,
    "rows": I64_PTR, "R": types.intp, "draw_seed": types.int64,  # steps of the results
    "mean": F64_PTR, "sd": F64_PTR, "drawn": F64_PTR, "terms": F64_PTR, "health": F64_PTR,
}  # fmt: skip

StatesArguments = arguments_class("StatesArguments", STATES_ARGUMENTS, __name__)


def _grid_states(
    table, dt, theta, n_theta, inputs, n_rows, tolerance, moment, steps, n_observations, observed,
    t0, rows, R, draw_seed, mean, sd, drawn, terms, health,
):  # fmt: skip
    """The states as one function for all systems; see `_evaluate` for what it writes."""
    system = read_system(table, dt, theta, n_theta, inputs, n_rows)
    at, record = carray(steps, (n_observations,)), carray(observed, (n_observations, system.p))
    wanted = Rows(
        carray(rows, (R,)), draw_seed, carray(mean, (R,)), carray(sd, (R,)), carray(drawn, (R,))
    )
    out = carray(terms, (n_observations,))
    code, j = _evaluate(system, at, record, t0, tolerance, moment, wanted, out)
    for failed in range(j, n_observations):
        out[failed] = -np.inf
    for i in range(R):
        if code != NONE and (moment == SMOOTHED or j == 0 or wanted.at[i] >= at[j]):
            wanted.mean[i], wanted.sd[i], wanted.drawn[i] = np.nan, np.nan, np.nan
    state = carray(health, (3,))
    failure = code if code >= NONE else TOO_FAR
    state[0], state[1], state[2] = np.inf, failure, j if code != NONE else -1


@njit_internal
def _evaluate(system, steps, observed, t0, tolerance, moment, rows, terms):
    """Write rows and terms; return (NONE, J), or (reason, observation) of a failure."""
    if not has_valid_covariances(system):
        return np.int64(COVARIANCE_NOT_POSITIVE), np.int64(0)
    stored = rows.at
    if moment == SMOOTHED and rows.at.size:
        stored = np.arange(rows.at[0], steps[-1] + 1)
    place, settings = ON_GRID, first_grid(system, steps, t0, tolerance)
    while place != END:
        if place == ON_SEGMENTS:
            code, j = states_on_segments(
                system, steps, observed, t0, tolerance, moment, rows, stored, terms
            )
        else:
            code, j = _states_on_grid(
                system, steps, observed, t0, settings, tolerance, moment, rows, stored, terms
            )
        place, settings = next_attempt(place, code, settings)
    return code, j


@njit_internal
def _states_on_grid(system, steps, observed, t0, settings, tolerance, moment, rows, stored, terms):
    """One attempt: write rows and terms; return (NONE, J), or (reason, observation) of a stop."""
    grids = [(np.int64(0), 1.0, terms)]  # lets numba infer the type of the empty list
    grids.clear()
    tape = grids, stored, moment
    code, j = attempt(system, steps, observed, t0, settings, tolerance, terms, _keep, tape)
    if moment != SMOOTHED:
        _write_rows(rows, grids)
    elif code == NONE and rows.at.size:
        code, j = _smooth(system, steps, observed, t0, settings, tolerance, terms, tape, rows)
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
def _smooth(system, steps, observed, t0, settings, tolerance, terms, tape, rows):
    """Write the smoothed rows in a backward pass; return (NONE, J), or (reason, observation)."""
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


GRID_STATES = EntryPoint(_grid_states, STATES_ARGUMENTS, "grid_states", digest("grid_states"))


def states_function(
    system: System, tolerance: float, moment: str
) -> CompiledFunction[StatesFunction]:
    """Compile "predicted", "filtered" or "smoothed" states."""
    bound = _bind(system, tolerance, MOMENTS[moment])
    evaluate = bound.function

    @njit_callable
    def run(theta, steps, observed, inputs, t0, seed, rows, draw_seed):
        mean, sd, drawn, _, health = evaluate(theta, steps, observed, inputs, t0, rows, draw_seed)
        n_effective = np.where(np.isnan(mean[:, 0]), np.nan, np.inf)
        return mean, sd, drawn, n_effective, health

    return CompiledFunction(run, key_of("states", bound.key))


def run_function(system: System, tolerance: float) -> CompiledFunction[RunFunction]:
    """Compile one run: terms, health and filtered moments."""
    bound = _bind(system, tolerance, FILTERED)
    evaluate = bound.function

    @njit_callable
    def run(theta, steps, observed, inputs, t0, seed, rows):
        mean, sd, _, terms, health = evaluate(theta, steps, observed, inputs, t0, rows, 0)
        cov = (sd * sd).reshape(rows.size, 1, 1)
        return terms, health, mean, cov, np.empty((rows.size, 0, 1)), np.empty((rows.size, 0))

    return CompiledFunction(run, key_of("run", bound.key))


def _bind(system: System, tolerance: float, moment: int) -> CompiledFunction:
    """Bind the entry point to one system: (record, rows, draw_seed) -> moments, terms, health."""
    GRID_STATES.compile()
    table = system_table(system, ("step_moments", "log_density"))
    evaluate, make_table, dt = GRID_STATES.external, table.make, system.dt

    @njit_callable
    def states(theta, steps, observed, inputs, t0, rows, draw_seed):
        # One state: what is (R, 1) for the caller is a vector here.
        mean, sd = np.full((rows.size, 1), np.nan), np.full((rows.size, 1), np.nan)
        drawn, terms = np.full((rows.size, 1), np.nan), np.full(steps.size, -np.inf)
        health = np.empty(3)
        health[0], health[1], health[2] = np.inf, OUT_OF_MEMORY, 0.0
        table = make_table()
        arguments = StatesArguments(
            table=table.ctypes.data, dt=dt, theta=theta.ctypes.data, n_theta=theta.size,
            inputs=inputs.ctypes.data, n_rows=inputs.shape[0], tolerance=tolerance, moment=moment,
            steps=steps.ctypes.data, n_observations=steps.size, observed=observed.ctypes.data,
            t0=t0, rows=rows.ctypes.data, R=rows.size, draw_seed=draw_seed, mean=mean.ctypes.data,
            sd=sd.ctypes.data, drawn=drawn.ctypes.data, terms=terms.ctypes.data,
            health=health.ctypes.data,
        )  # fmt: skip
        evaluate(*arguments)
        keep_alive(table)
        return mean, sd, drawn, terms, health

    key = key_of(f"grid states {tolerance!r} {moment}", table.key, GRID_STATES.key)
    return CompiledFunction(states, key)
