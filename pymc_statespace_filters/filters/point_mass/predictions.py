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
from ..plan import PLAN, read_system, settings_of, simulate
from .law import law_before, new_tape, points_of_law
from .moments import total_mass
from .segment_pass import along_record, finished


class Laws(NamedTuple):
    """What is written, see `signatures.PREDICTIONS`."""

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
    law, tape = law_before(system, np.empty(0)), new_tape(data.steps, True)
    _, known = along_record(system, data, law, False, tolerance, np.empty(J), tape, finished, None)
    for j in range(known):
        _write_law(system, data, tape.laws[j], laws, j)
    return status


@njit_internal
def unknown_laws(call):
    """The laws that a call asks for, which are still to be written."""
    to, p, J = call.results, call.plan[PLAN.p], call.record[RECORD.n_rows]
    laws = Laws(
        reals_at(to[RESULTS.predicted], (J, p)), reals_at(to[RESULTS.predicted_cov], (J, p, p)),
        reals_at(to[RESULTS.log_below], (J, p)), reals_at(to[RESULTS.log_above], (J, p)),
    )  # fmt: skip
    laws.mean[:], laws.cov[:], laws.log_below[:], laws.log_above[:] = np.nan, np.nan, np.nan, np.nan
    return laws


@njit_internal
def _write_law(system, record, law, laws, j):
    """Write the law of row j from that of the state before it.

    As many points as a row of masses has lie beside each other; the next ones may be elsewhere.
    """
    h, roots = observations_at(system, law.k, record.t0 + law.k * system.dt, points_of_law(law))
    n_together = law.parts.mass.shape[1]
    mass = law.parts.mass.reshape(law.parts.mass.size)
    write_mixture(mass, 1.0 / total_mass(mass), n_together, h, roots, record.observed[j], laws, j)


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
