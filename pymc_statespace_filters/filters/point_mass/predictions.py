"""The law of every observation given those before it, by the point-mass filter.

An observation with additive Gaussian noise has the mixture over the grid before its update,

    p(d_j | d_1 .. d_{j-1}) = sum_i mass_i N(d_j; h(x_i), R(x_i)),

whose moments and distribution functions are sums.
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
from pymc_statespace_filters.compiler.native.jit import keep_alive, njit_callable, njit_internal
from pymc_statespace_filters.filters.outcomes import NONE
from pymc_statespace_filters.filters.point_mass.forward_pass import (
    END,
    ON_GRID,
    ON_SEGMENTS,
    attempt,
    first_grid,
    next_attempt,
)
from pymc_statespace_filters.filters.point_mass.grid import grid_points
from pymc_statespace_filters.filters.point_mass.moments import total_mass
from pymc_statespace_filters.filters.point_mass.recursion import has_valid_covariances
from pymc_statespace_filters.filters.point_mass.segment_pass import (
    pass_on_segments,
)
from pymc_statespace_filters.filters.point_mass.segments import POINTS, points_of
from pymc_statespace_filters.filters.protocol import PredictionsFunction, System
from pymc_statespace_filters.filters.system_table import (
    SYSTEM_ARGUMENTS,
    observe,
    read_system,
    system_table,
)

PREDICTIONS_ARGUMENTS = SYSTEM_ARGUMENTS | {
    "tolerance": types.float64,
    "steps": I64_PTR, "n_observations": types.intp, "observed": F64_PTR, "t0": types.float64,
    "mean": F64_PTR, "cov": F64_PTR, "log_below": F64_PTR, "log_above": F64_PTR,
}  # fmt: skip

PredictionsArguments = arguments_class("PredictionsArguments", PREDICTIONS_ARGUMENTS, __name__)


class _Laws(NamedTuple):
    """What is written; ``next`` (1,) is the number of the next observation."""

    next: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    log_below: np.ndarray
    log_above: np.ndarray


def _grid_predictions(
    table, dt, theta, n_theta, inputs, n_rows, tolerance, steps, n_observations, observed, t0,
    mean, cov, log_below, log_above,
):  # fmt: skip
    """The predictions as one function for all systems; what it does not reach stays as it is."""
    system = read_system(table, dt, theta, n_theta, inputs, n_rows)
    J, p = n_observations, system.p
    at, record = carray(steps, (J,)), carray(observed, (J, p))
    laws = _Laws(
        np.zeros(1, np.int64), carray(mean, (J, p)), carray(cov, (J, p, p)),
        carray(log_below, (J, p)), carray(log_above, (J, p)),
    )  # fmt: skip
    if not has_valid_covariances(system):
        return
    place, settings = ON_GRID, first_grid(system, at, t0, tolerance)
    terms, tape = np.empty(J), (system, at, record, t0, laws)
    while place != END:
        if place == ON_SEGMENTS:
            code, j = pass_on_segments(
                system, at, record, t0, tolerance, terms, _predict_on_segments, tape
            )
        else:
            code, j = attempt(system, at, record, t0, settings, tolerance, terms, _predict, tape)
        place, settings = next_attempt(place, code, settings)
    if code != NONE:
        _forget(laws, j)


@njit_internal
def _forget(laws, first):
    """Leave the laws from a failing observation on unknown."""
    for j in range(first, laws.mean.shape[0]):
        for b in range(laws.mean.shape[1]):
            laws.mean[j, b] = laws.log_below[j, b] = laws.log_above[j, b] = np.nan
            for a in range(laws.mean.shape[1]):
                laws.cov[j, a, b] = np.nan


@njit_internal
def _predict(tape, k, grid, updated):
    """Write the law of the observation at step k, if there is one, from the grid before it."""
    low, spacing, mass = grid
    if not updated:
        _write_law(tape, k, grid_points(low, mass.size, spacing), mass, mass.size)


@njit_internal
def _predict_on_segments(tape, k, segments):
    """The same from segments."""
    n = segments.low.size
    X = np.empty((1, n * POINTS))
    for p in range(n):
        points_of(segments.low[p], segments.high[p], X[0, p * POINTS : (p + 1) * POINTS])
    _write_law(tape, k, X, segments.predicted.reshape(n * POINTS), POINTS)


@njit_internal
def _write_law(tape, k, X, mass, n_together):
    """Write the law of the next observation, if it is at step k, from masses at the points X.

    So many points in turn lie beside each other, and the next ones may be elsewhere.
    """
    system, steps, observed, t0, laws = tape
    if k == 0:  # the first pass, or a repeated one
        laws.next[0] = 0
    j = laws.next[0]
    if j == steps.size or steps[j] != k:
        return
    laws.next[0] = j + 1
    h, roots = _observations(system, k, t0 + k * system.dt, X)
    weight = 1.0 / total_mass(mass)
    _write_moments(mass, weight, h, roots, laws.mean[j], laws.cov[j])
    for b in range(system.p):
        below, above = 0.0, 0.0
        for i in range(mass.size):
            variance = 0.0
            for a in range(system.p):
                variance += roots[a, b, i] * roots[a, b, i]
            first = i - i % n_together
            variance += _variance_of_cell(h[b, first : first + n_together], i - first, variance)
            z = (observed[j, b] - h[b, i]) / math.sqrt(2.0 * variance)
            if mass[i] > 0.0:
                below += 0.5 * weight * mass[i] * math.erfc(-z)
                above += 0.5 * weight * mass[i] * math.erfc(z)
        laws.log_below[j, b], laws.log_above[j, b] = math.log(below), math.log(above)


@njit_internal
def _observations(system, k, t, X):
    """h (p, n) at every point, and what each standard normal adds to it (p, p, n)."""
    p, n = system.p, X.shape[1]
    h, roots, Z = np.empty((p, n)), np.empty((p, p, n)), np.zeros((p, n))
    observe(system, k, t, Z.ctypes.data, n, X, h)
    for a in range(p):
        Z[a, :] = 1.0
        observe(system, k, t, Z.ctypes.data, n, X, roots[a])
        Z[a, :] = 0.0
        for b in range(p):
            for i in range(n):
                roots[a, b, i] -= h[b, i]
    keep_alive(Z)
    return h, roots


@njit_internal
def _variance_of_cell(h, i, noise_variance):
    """The variance of h over the cell of a point, for cells much wider than the noise, else zero.

    There the sum over points would be a staircase. Elsewhere it converges without.
    """
    first, last = max(i - 1, 0), min(i + 1, h.size - 1)
    width = (h[last] - h[first]) / max(last - first, 1)
    return width * width / 12.0 if width * width > 4.0 * noise_variance else 0.0


@njit_internal
def _write_moments(mass, weight, h, roots, mean, cov):
    """Mean and covariance of the mixture."""
    p = mean.size
    for b in range(p):
        mean[b] = 0.0
        for i in range(mass.size):
            mean[b] += weight * mass[i] * h[b, i]
    for b in range(p):
        for c in range(p):
            cov[b, c] = 0.0
            for i in range(mass.size):
                product = (h[b, i] - mean[b]) * (h[c, i] - mean[c])
                for a in range(p):
                    product += roots[a, b, i] * roots[a, c, i]
                cov[b, c] += weight * mass[i] * product


GRID_PREDICTIONS = EntryPoint(
    _grid_predictions, PREDICTIONS_ARGUMENTS, "grid_predictions", digest("grid_predictions")
)


def predictions_function(system: System, tolerance: float) -> CompiledFunction[PredictionsFunction]:
    """Compile the law of every observation."""
    GRID_PREDICTIONS.compile()
    table = system_table(system, ("step_moments", "log_density", "observe"))
    evaluate, make_table, dt, p = GRID_PREDICTIONS.external, table.make, system.dt, system.p

    @njit_callable
    def run(theta, steps, observed, inputs, t0, seed):
        J = steps.size
        mean, cov = np.full((J, p), np.nan), np.full((J, p, p), np.nan)
        log_below, log_above = np.full((J, p), np.nan), np.full((J, p), np.nan)
        table = make_table()
        arguments = PredictionsArguments(
            table=table.ctypes.data, dt=dt, theta=theta.ctypes.data, n_theta=theta.size,
            inputs=inputs.ctypes.data, n_rows=inputs.shape[0], tolerance=tolerance,
            steps=steps.ctypes.data, n_observations=J, observed=observed.ctypes.data, t0=t0,
            mean=mean.ctypes.data, cov=cov.ctypes.data, log_below=log_below.ctypes.data,
            log_above=log_above.ctypes.data,
        )  # fmt: skip
        evaluate(*arguments)
        keep_alive(table)
        return mean, cov, log_below, log_above

    key = key_of(f"grid predictions {tolerance!r}", table.key, GRID_PREDICTIONS.key)
    return CompiledFunction(run, key)
