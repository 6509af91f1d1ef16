"""States of the point-mass filter: laws of the state at chosen steps, and draws from them.

Forwards the filter's own pass leaves its grids, of masses p(x_k | d_1 .. d_k), on a tape. Back from
the last of them goes, on the same points and with the same kernels, the ratio

    b_k(x_k) = p(x_k | D) / p(x_k | d_1 .. d_k)
             = integral of N(x_{k+1}; g(x_k, 0), s(x_k)^2) p(d_{k+1} | x_{k+1}) b_{k+1}(x_{k+1})
               dx_{k+1} / p(d_{k+1} | d_1 .. d_k),

in which steps without an observation have no factor of p(d | x). It is one at the last observation
(G. Kitagawa, "Non-Gaussian state-space modeling of nonstationary time series", JASA 82, 1987). A
trajectory is drawn back along the tape too, from p(x_k | x_{k+1}, d_1 .. d_k), which does not use
the ratio: masses times the kernel at the x_{k+1} that was drawn.
"""

import math
from typing import NamedTuple

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
    njit_contract,
    njit_internal,
)
from pymc_statespace_filters.compiler.numerics.philox import STATES, uniform_at
from pymc_statespace_filters.compiler.numerics.restricted_domain import exp
from pymc_statespace_filters.filters.outcomes import (
    COVARIANCE_NOT_POSITIVE,
    NONE,
    OUT_OF_MEMORY,
    ZERO_WEIGHTS,
    is_missing,
)
from pymc_statespace_filters.filters.point_mass.forward_pass import (
    attempt,
    first_lattice,
    next_lattice,
)
from pymc_statespace_filters.filters.point_mass.grid import gather, gather_rows, lattice
from pymc_statespace_filters.filters.point_mass.moments import draw, mass_of, mean_and_sd
from pymc_statespace_filters.filters.point_mass.recursion import (
    TOO_SHORT,
    has_valid_covariances,
    no_table,
    rows_from,
    step_from,
)
from pymc_statespace_filters.filters.protocol import RunFunction, StatesFunction, System
from pymc_statespace_filters.filters.system_table import (
    SYSTEM_ARGUMENTS,
    log_density,
    read_system,
    system_table,
)

PREDICTED, FILTERED, SMOOTHED = range(3)
MOMENTS = {"predicted": PREDICTED, "filtered": FILTERED, "smoothed": SMOOTHED}
"""Given the observations of earlier steps, of the step's own too, of all."""

STATES_ARGUMENTS = SYSTEM_ARGUMENTS | {
    "tolerance": types.float64, "moment": types.intp,
    "steps": I64_PTR, "n_observations": types.intp, "observed": F64_PTR, "t0": types.float64,
    "rows": I64_PTR, "R": types.intp, "draw_seed": types.int64,  # the steps wanted, and their draws
    "mean": F64_PTR, "sd": F64_PTR, "drawn": F64_PTR, "terms": F64_PTR, "health": F64_PTR,
}  # fmt: skip

StatesArguments = arguments_class("StatesArguments", STATES_ARGUMENTS, __name__)


class _Rows(NamedTuple):
    """What is written: the mean, the deviation and a draw of the state at the steps ``at``."""

    at: np.ndarray
    draw_seed: int
    mean: np.ndarray
    sd: np.ndarray
    drawn: np.ndarray


def _grid_states(
    table, dt, theta, n_theta, inputs, n_rows, tolerance, moment, steps, n_observations, observed,
    t0, rows, R, draw_seed, mean, sd, drawn, terms, health,
):  # fmt: skip
    """The states as one function for all systems; see `_evaluate` for what it writes."""
    system = read_system(table, dt, theta, n_theta, inputs, n_rows)
    at, record = carray(steps, (n_observations,)), carray(observed, (n_observations, system.p))
    wanted = _Rows(
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
    failure = code if code >= NONE else ZERO_WEIGHTS
    state[0], state[1], state[2] = np.inf, failure, j if code != NONE else -1


@inline_always
def _evaluate(system, steps, observed, t0, tolerance, moment, rows, terms):
    """Write rows and terms: (NONE, J), or (a reason, the observation that failed)."""
    if not has_valid_covariances(system):
        return np.int64(COVARIANCE_NOT_POSITIVE), np.int64(0)
    kept = rows.at
    if moment == SMOOTHED and rows.at.size:
        kept = np.arange(rows.at[0], steps[-1] + 1)
    spacing, reach = first_lattice(system, steps, t0, tolerance)
    while True:
        grids = [(np.int64(0), 1.0, terms)]  # tells the type
        grids.clear()
        tape = grids, kept, moment
        code, j = attempt(
            system, steps, observed, t0, spacing, reach, tolerance, terms, _keep, tape
        )
        if moment == SMOOTHED and code == NONE and rows.at.size:
            code, j = _back(
                system, steps, observed, t0, spacing, reach, tolerance, terms, tape, rows
            )
        again, spacing, reach = next_lattice(code, spacing, reach)
        if not again:
            break
    if moment != SMOOTHED:
        _write_all(rows, grids)
    return code, j


@njit_internal
def _keep(tape, k, grid, seen):
    """Put a grid on the tape, or in the place of the forecast what was seen there made of it."""
    grids, kept, moment = tape
    n = len(grids)
    low, spacing, mass = grid
    if not seen:
        if n < kept.size and kept[n] == k:
            grids.append((low, spacing, mass.copy()))  # the next step may take mass off
    elif moment != PREDICTED and n > 0 and kept[n - 1] == k:
        grids[n - 1] = low, spacing, mass.copy()


@njit_internal
def _write_all(rows, grids):
    """Write the law of each grid; rows that were not reached are NaN."""
    for i in range(rows.at.size):
        rows.mean[i], rows.sd[i], rows.drawn[i] = np.nan, np.nan, np.nan
        if i < len(grids):
            low, spacing, mass = grids[i]
            rows.mean[i], rows.sd[i] = mean_and_sd(low, spacing, mass)
            u = uniform_at(rows.draw_seed, STATES, rows.at[i], 0)
            rows.drawn[i] = draw(low, spacing, mass, u)


@njit_internal
def _back(system, steps, observed, t0, spacing, reach, tolerance, terms, tape, rows):
    """The pass back, which writes the smoothed rows: (NONE, J), or (why it stopped, where)."""
    grids, kept, _ = tape
    table, later = no_table(), grids[-1]
    weights, ratio = later[2], np.ones(later[2].size)
    drawn = 0.0
    i, j = rows.at.size - 1, steps.size - 1
    for place in range(kept.size - 1, -1, -1):
        k, grid = kept[place], grids[place]
        low, here, mass = grid
        t = t0 + k * system.dt
        if k < kept[-1]:
            mean, sd, ratio, table = _step_back(
                system, k, t, spacing, reach, grid, table, later, ratio
            )
            weights = _given_next(mass, mean, sd, drawn)
        smoothed = mass * ratio
        if not _holds(smoothed, tolerance):
            return TOO_SHORT, min(j + 1, steps.size - 1)
        drawn = draw(low, here, weights, uniform_at(rows.draw_seed, STATES, k, 0))
        if rows.at[i] == k:
            rows.mean[i], rows.sd[i] = mean_and_sd(low, here, smoothed)
            rows.drawn[i] = drawn
            i -= 1
        if j >= 0 and steps[j] == k:
            if not is_missing(observed, j):
                _see_back(system, k, t, observed[j], grid, terms[j], ratio)
            j -= 1
        later = grid
    return NONE, steps.size


@njit_internal
def _step_back(system, k, t, spacing, reach, grid, table, later, ratio):
    """From the ratio on the grid ``later`` to that one step before: (mean, sd, ratio, table)."""
    low, _, mass = grid
    tabled, mean, sd, _, table = step_from(system, k, t, spacing, reach, grid, table)
    if tabled and later[1] == spacing:
        starts, ends, masses = rows_from(low, table)
        ratio = gather_rows(starts, ends, masses, later[0], ratio, mass.size)
    else:
        ratio = gather(later[0], later[1], ratio, mean, sd, reach)
    return mean, sd, ratio, table


@njit_internal
def _given_next(mass, mean, sd, x):
    """Masses times the densities of the state x one step later."""
    out = np.empty(mass.size)
    for i in range(mass.size):
        z = (x - mean[i]) / sd[i]
        weight = mass[i] / sd[i] * exp(-0.5 * z * z)
        out[i] = weight if weight > 0.0 else 0.0  # what has gone to infinity gives NaN
    return out


@inline_always
def _holds(smoothed, tolerance):
    """Whether a grid holds the smoothed density, and has not lost it beyond an end."""
    whole = mass_of(smoothed)
    if not (whole > 0.0 and whole < np.inf):
        return False
    return smoothed.size == 1 or smoothed[0] + smoothed[-1] <= tolerance * whole


@njit_internal
def _see_back(system, k, t, d, grid, term, ratio):
    """Multiply by p(d | x) / p(d | d_1 ..), in place; what has no mass has no ratio."""
    low, spacing, mass = grid
    log_likelihood = np.empty(mass.size)
    log_density(system, k, t, d, lattice(low, mass.size, spacing), log_likelihood)
    for i in range(mass.size):
        is_seen = mass[i] > 0.0 and log_likelihood[i] < np.inf
        ratio[i] *= math.exp(log_likelihood[i] - term) if is_seen else 0.0


GRID_STATES = EntryPoint(_grid_states, STATES_ARGUMENTS, "grid_states", digest("grid_states"))


def states_function(
    system: System, tolerance: float, moment: str
) -> CompiledFunction[StatesFunction]:
    """Compile "predicted", "filtered" or "smoothed" states."""
    bound = _bind(system, tolerance, MOMENTS[moment])
    evaluate = bound.function

    @njit_contract
    def run(theta, steps, observed, inputs, t0, seed, rows, draw_seed):
        mean, sd, drawn, _, health = evaluate(theta, steps, observed, inputs, t0, rows, draw_seed)
        n_effective = np.where(np.isnan(mean[:, 0]), np.nan, np.inf)
        return mean, sd, drawn, n_effective, health

    return CompiledFunction(run, key_of("states", bound.key))


def run_function(system: System, tolerance: float) -> CompiledFunction[RunFunction]:
    """Compile one run: terms, health and filtered moments."""
    bound = _bind(system, tolerance, FILTERED)
    evaluate = bound.function

    @njit_contract
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

    @njit_contract
    def states(theta, steps, observed, inputs, t0, rows, draw_seed):
        # One state: what is (R, 1) for the caller is a vector here.
        mean, sd = np.full((rows.size, 1), np.nan), np.full((rows.size, 1), np.nan)
        drawn, terms = np.full((rows.size, 1), np.nan), np.full(steps.size, -np.inf)
        health = np.empty(3)
        health[0], health[1], health[2] = np.inf, OUT_OF_MEMORY, 0.0
        table = make_table()
        arguments = StatesArguments(
            table=table.ctypes.data,
            dt=dt,
            theta=theta.ctypes.data,
            n_theta=theta.size,
            inputs=inputs.ctypes.data,
            n_rows=inputs.shape[0],
            tolerance=tolerance,
            moment=moment,
            steps=steps.ctypes.data,
            n_observations=steps.size,
            observed=observed.ctypes.data,
            t0=t0,
            rows=rows.ctypes.data,
            R=rows.size,
            draw_seed=draw_seed,
            mean=mean.ctypes.data,
            sd=sd.ctypes.data,
            drawn=drawn.ctypes.data,
            terms=terms.ctypes.data,
            health=health.ctypes.data,
        )
        evaluate(*arguments)
        keep_alive(table)
        return mean, sd, drawn, terms, health

    key = key_of(f"grid states {tolerance!r} {moment}", table.key, GRID_STATES.key)
    return CompiledFunction(states, key)
