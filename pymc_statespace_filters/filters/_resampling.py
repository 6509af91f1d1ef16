"""Resampling: draw N ancestors in proportion to the weights (thesis, section 4.4.1), in O(N).

Every scheme is a set of N increasing points in (0, 1) and a walk along the cumulative weights. In
"sorted" the points are the systematic ones and the walk goes from neighbour to neighbour
(`_order`), so that normals and particles that move little are resampled almost alike, and stand in
that order afterwards (Deligiannidis, Doucet and Pitt 2018; Gerber and Chopin 2015).

Differences from the source: the thesis copies particle n when v_n <= u < v_{n+1}, an interval that
belongs to particle n + 1; here it is v_{n-1} <= u < v_n with v_0 = 0. It also draws N + 1 times;
here N.
"""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters._compile import compiled, pasted
from pymc_statespace_filters.filters._order import (
    MOST_STATES,
    OrderWork,
    order_particles,
    order_workspace,
)
from pymc_statespace_filters.filters._random import exponential, padded, uniform


@compiled
def systematic(z, points):
    """Points (i + u) / N with one uniform u from two normals; the last of N + 1 is not used."""
    n = points.size - 1
    u = uniform(z[0], z[1])
    for i in range(n):
        points[i] = (i + u) / n


@compiled
def multinomial(z, points):
    """N sorted uniforms: partial sums of N + 1 exponentials over their total."""
    n = points.size - 1
    half = z.size // 2
    for i in range(n + 1):
        points[i] = exponential(z[i], z[half + i])
    for i in range(1, n + 1):
        points[i] += points[i - 1]
    for i in range(n):
        points[i] /= points[n]


POINTS = {"systematic": systematic, "multinomial": multinomial, "sorted": systematic}
SCHEMES = tuple(POINTS)
_MULTINOMIAL, _SORTED = SCHEMES.index("multinomial"), SCHEMES.index("sorted")


class Resampling(NamedTuple):
    """When and how to resample, and scratch for it."""

    threshold: float
    multinomial: bool
    in_order: bool
    always: bool
    points: np.ndarray
    ancestors: np.ndarray
    order_work: OrderWork
    w_ordered: np.ndarray


@pasted
def resampler(fraction, scheme, n_states, n_particles):
    """Resample below this fraction of the particles, by the scheme of this number."""
    points, ancestors = np.empty(n_particles + 1), np.empty(n_particles, np.int64)
    in_order = scheme == _SORTED
    n_ordered = n_particles if in_order else 0
    return Resampling(
        fraction * n_particles, scheme == _MULTINOMIAL, in_order, fraction == 1.0,
        points, ancestors, order_workspace(n_states, n_ordered), np.empty(n_ordered),
    )  # fmt: skip


@pasted
def resample_if_few(resampling, n_effective, z, log_w, w, X, buffer):
    """Draw new particles of equal weight if the effective number is below the threshold.

    ``z`` are the normals that a resampling takes; ``buffer`` is of the size of X. Returns whether
    it was done; ``ancestors`` tell then who became whom.
    """
    if not (resampling.always or n_effective < resampling.threshold):
        return False
    points, ancestors, N = resampling.points, resampling.ancestors, w.size
    if resampling.multinomial:
        multinomial(z, points)
    else:
        systematic(z, points)
    if resampling.in_order:
        order = order_particles(w, X, resampling.order_work)
        choose_in_order(w, order, points, resampling.w_ordered, ancestors)
    else:
        choose_ancestors(w, points, ancestors)
    copy_ancestors(ancestors, X, buffer)
    for i in range(N):
        log_w[i] = -math.log(N)
    return True


def smooth_resampling(filter: Any, n_states: int) -> Any:
    """Give a particle filter's version whose estimate moves little when its normals do.

    Whether to resample is a jump of its own, which is avoided by resampling at every observation
    where the order of the particles is exact. Along a curve through several dimensions it is not,
    and resampling less often is better.
    """
    always = {"resample_below": 1.0} if n_states == 1 else {}
    return replace(filter, resampling="sorted", **always)


def n_normals(scheme: str, n_particles: int) -> int:
    """Normals that a scheme takes, a whole number of blocks."""
    return 2 * padded(n_particles + 1) if scheme == "multinomial" else padded(2)


def check_sortable(scheme: str, n_states: int) -> None:
    """Raise if the scheme orders particles and cannot order those of so many states."""
    if scheme == "sorted" and n_states > MOST_STATES:
        raise ModelError(
            f"resampling='sorted' orders particles of at most {MOST_STATES} states, this system "
            f"has {n_states}; take resampling='systematic'"
        )


@compiled
def choose_ancestors(w, points, ancestors):
    """Ancestor of each point: the n with v_{n-1} <= u < v_n, v the cumulative weights (Eq. 4.44).

    A particle of zero weight has an empty interval. The end is the last particle that has weight,
    whatever rounding makes of the last cumulative sum.
    """
    last = w.size - 1
    while last > 0 and not w[last] > 0.0:
        last -= 1
    total = 0.0
    for weight in w:
        total += weight
    n, cumulative = 0, w[0]
    for i in range(ancestors.size):
        while n < last and points[i] * total >= cumulative:
            n += 1
            cumulative += w[n]
        ancestors[i] = n


@compiled
def choose_in_order(w, order, points, w_ordered, ancestors):
    """Ancestor of each point on a walk along the particles in this order."""
    for i in range(order.size):
        w_ordered[i] = w[order[i]]
    choose_ancestors(w_ordered, points, ancestors)
    for i in range(ancestors.size):
        ancestors[i] = order[ancestors[i]]


@compiled
def copy_ancestors(ancestors, X, buffer):
    """Replace the columns of X (states, particles) by those of their ancestors."""
    for a in range(X.shape[0]):
        row, old = X[a], buffer[a]
        for i in range(row.size):
            old[i] = row[i]
        for i in range(row.size):
            row[i] = old[ancestors[i]]
