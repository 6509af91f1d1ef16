"""The law of every observation given those before it, by the point-mass filter.

An observation with additive Gaussian noise has the mixture over the grid before its update,

    p(d_j | d_1 .. d_{j-1}) = sum_i mass_i N(d_j; h(x_i), R(x_i)),

whose moments and distribution functions are sums.
"""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import keep_alive, njit_internal
from ...compiler.native.plan import RECORD, REQUEST, RESULTS, plan_entry
from ..calls import OK, opened, reals_at, single_record
from ..outcomes import NONE
from ..plan import PLAN, read_system, settings_of, simulate
from .grid import grid_points
from .moments import total_mass
from .segment_pass import along_record
from .segments import POINTS, points_of


class Laws(NamedTuple):
    """What is written; ``next`` (1,) is the number of the next observation."""

    next: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    log_below: np.ndarray
    log_above: np.ndarray


def _grid_predictions(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    if status != OK or call.request[REQUEST.sizes_only]:
        return status
    J = call.record[RECORD.n_rows]
    data, laws = single_record(call, 0, 0, J), unknown_laws(call)
    system, tolerance = read_system(call.plan, data.theta, data.inputs), settings_of(call.plan)[0]
    if system.failure != NONE:
        return status
    code, j = along_record(
        system, data, np.empty(0), tolerance, np.empty(J), _predict, _predict_on_segments,
        (system, data, laws),
    )  # fmt: skip
    if code != NONE:
        forget(laws, j)
    return status


@njit_internal
def unknown_laws(call):
    """The laws that a call asks for, which are still to be written."""
    to, p, J = call.results, call.plan[PLAN.p], call.record[RECORD.n_rows]
    laws = Laws(
        np.zeros(1, np.int64), reals_at(to[RESULTS.predicted], (J, p)),
        reals_at(to[RESULTS.predicted_cov], (J, p, p)), reals_at(to[RESULTS.log_below], (J, p)),
        reals_at(to[RESULTS.log_above], (J, p)),
    )  # fmt: skip
    forget(laws, 0)
    return laws


@njit_internal
def forget(laws, first):
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
    system, record, laws = tape
    if k == 0:  # the first pass, or a repeated one
        laws.next[0] = 0
    j = laws.next[0]
    if j == record.steps.size or record.steps[j] != k:
        return
    laws.next[0] = j + 1
    h, roots = observations_at(system, k, record.t0 + k * system.dt, X)
    weight = 1.0 / total_mass(mass)
    write_mixture(mass, weight, n_together, h, roots, record.observed[j], laws, j)


@njit_internal
def observations_at(system, k, t, X):
    """h (p, n) at every point, and what each standard normal adds to it (p, p, n)."""
    p, n = system.p, X.shape[1]
    h, roots, Z = np.empty((p, n)), np.empty((p, p, n)), np.zeros((p, n))
    simulate(system, k, t, Z.ctypes.data, n, X, h)
    for a in range(p):
        Z[a, :] = 1.0
        simulate(system, k, t, Z.ctypes.data, n, X, roots[a])
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
def write_mixture(mass, weight, n_together, h, roots, d, laws, j):
    """Write the law of row j, a mixture of normals at masses that add up to 1 / weight."""
    _write_mixture_moments(mass, weight, h, roots, laws.mean[j], laws.cov[j])
    p = d.size
    for b in range(p):
        below, above = 0.0, 0.0
        for i in range(mass.size):
            variance = 0.0
            for a in range(p):
                variance += roots[a, b, i] * roots[a, b, i]
            first = i - i % n_together
            variance += _variance_of_cell(h[b, first : first + n_together], i - first, variance)
            z = (d[b] - h[b, i]) / math.sqrt(2.0 * variance)
            if mass[i] > 0.0:
                below += 0.5 * weight * mass[i] * math.erfc(-z)
                above += 0.5 * weight * mass[i] * math.erfc(z)
        laws.log_below[j, b], laws.log_above[j, b] = math.log(below), math.log(above)


@njit_internal
def _write_mixture_moments(mass, weight, h, roots, mean, cov):
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


GRID_PREDICTIONS = plan_entry(_grid_predictions, "grid_predictions")
"""The law of every observation."""
