"""Resampling: draw N ancestors in proportion to the weights (thesis, section 4.4.1), in O(N).

Every scheme is a set of N increasing points in (0, 1) and one pass over the cumulative weights.
"sorted" uses the systematic points and takes the particles in the order of `hilbert_sort`, in which
the new particles stay: small changes of particles and normals change the resampled set little
(Deligiannidis, Doucet and Pitt 2018; Gerber and Chopin 2015).

Differences from the source: the thesis copies particle n when v_n <= u < v_{n+1}, an interval that
belongs to particle n + 1; here it is v_{n-1} <= u < v_n with v_0 = 0. It also draws N + 1 times;
here N.
"""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.numerics.normals import BLOCK, exponential, padded, uniform
from ...errors import ModelError
from .hilbert_sort import MOST_STATES, OrderWork, order_at, order_workspace
from .reductions import MEMBERS, allgather, sum_blocks


@njit_internal
def systematic(z, points):
    """Points (i + u) / N with one uniform u from two normals; the last of N + 1 is unused."""
    n = points.size - 1
    u = uniform(z[0], z[1])
    for i in range(n):
        points[i] = (i + u) / n


@njit_internal
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
_MULTINOMIAL = SCHEMES.index("multinomial")


class Resampling(NamedTuple):
    """When and how to resample, and scratch.

    ``order`` is the address of the entry point that sorts particles, 0 if they are not sorted.
    ``all_particles`` (1 + n, N) holds weights and states of the particles of all ranks,
    ``cumulative`` the cumulative weights at the end of each block.
    """

    threshold: float
    multinomial: bool
    order: int
    always: bool
    points: np.ndarray
    ancestors: np.ndarray
    all_particles: np.ndarray
    cumulative: np.ndarray
    order_work: OrderWork
    w_ordered: np.ndarray


@njit_internal
def resampler(fraction, scheme, order, n_states, local):
    """Settings and scratch: resample below ``fraction`` of the particles, by scheme number.

    Of a filter that never does, by a negative fraction, there is no scratch.
    """
    N, size = (local.n_members, local.size) if fraction >= 0.0 else (0, 0)
    n_ordered = N if order != 0 else 0
    return Resampling(
        fraction * N, scheme == _MULTINOMIAL, order, fraction == 1.0,
        np.empty(N + 1), np.empty(size, np.int64),
        np.empty((1 + n_states, N)), np.empty(local.sums.shape[1]),
        order_workspace(n_states, n_ordered), np.empty(n_ordered),
    )  # fmt: skip


@njit_internal
def resample_if_few(resampling, n_effective, z, log_w, w, X, local):
    """Draw new particles of equal weight if the effective number is below the threshold.

    ``z`` are the normals of the scheme. Returns whether particles were resampled; their indices
    before are then in ``ancestors``.
    """
    if not (resampling.always or n_effective < resampling.threshold):
        return False
    resample(resampling, z, w, X, local)
    for i in range(log_w.size):
        log_w[i] = -math.log(local.n_members)
    return True


@njit_internal
def resample(resampling, z, w, X, local):
    """Replace the particles by draws in proportion to w."""
    points, ancestors = resampling.points, resampling.ancestors
    if resampling.multinomial:
        multinomial(z, points)
    else:
        systematic(z, points)
    particles = resampling.all_particles
    gather_particles(w, X, local, particles)
    w_all, X_all = particles[0], particles[1:]
    local_points = points[local.first :]
    if resampling.order != 0:
        order = order_at(resampling.order, particles, resampling.order_work)
        w_ordered = resampling.w_ordered
        choose_in_order(w_all, order, local_points, w_ordered, resampling.cumulative, ancestors)
    else:
        choose_ancestors(w_all, local_points, resampling.cumulative, ancestors)
    copy_ancestors(X_all, ancestors, X)


def smooth_resampling(filter: Any, n_states: int) -> Any:
    """Return a version of a particle filter whose estimate changes little with its normals.

    The decision to resample is discontinuous too. With one state, where sorted resampling is
    smooth, it is avoided by resampling at every observation. With several states the order along
    the curve is not continuous, and resampling less often is better.
    """
    always = {"resample_below": 1.0} if n_states == 1 else {}
    return replace(filter, resampling="sorted", **always)


def n_normals(scheme: str, n_particles: int) -> int:
    """Number of normals of a resampling, in whole blocks; a scheme leaves the last of each half."""
    return 2 * padded(n_particles + 2) if scheme == "multinomial" else padded(2)


def check_sortable(scheme: str, n_states: int) -> None:
    """Raise if the scheme sorts particles and cannot sort those of so many states."""
    if scheme == "sorted" and n_states > MOST_STATES:
        raise ModelError(
            f"resampling='sorted' orders particles of at most {MOST_STATES} states, this system "
            f"has {n_states}; use resampling='systematic'"
        )


@njit_internal
def gather_particles(w, X, local, all_particles):
    """Weights and states of the particles of all ranks, (1 + n, N)."""
    local_columns = all_particles[:, local.first : local.first + local.size]
    for i in range(w.size):
        local_columns[0, i] = w[i]
    for a in range(X.shape[0]):
        for i in range(w.size):
            local_columns[1 + a, i] = X[a, i]
    allgather(local.layout, all_particles, MEMBERS)


@njit_internal
def choose_ancestors(w, points, cumulative, ancestors):
    """Ancestor of each point: the n with v_{n-1} <= u < v_n, v the cumulative weights (Eq. 4.44).

    ``cumulative`` receives the weights up to the end of each block of 64; within a block weights
    are added from there on, so that a rank's search need not start at the first particle.

    A particle of zero weight has an empty interval. The last particle with a positive weight ends
    the search, however the last cumulative sum was rounded.
    """
    sum_blocks(w, cumulative)
    last_block = cumulative.size - 1
    for block in range(last_block):
        cumulative[block + 1] += cumulative[block]
    total = cumulative[last_block]
    while last_block > 0 and cumulative[last_block - 1] == total:
        last_block -= 1
    block, end, n, last, v = -1, -1.0, 0, 0, 0.0
    for i in range(ancestors.size):
        u = points[i] * total
        if u >= end:
            block += 1
            while block < last_block and u >= cumulative[block]:
                block += 1
            end = cumulative[block] if block < last_block else np.inf
            n, last = BLOCK * block, _last_of_weight(w, BLOCK * block)
            v = w[n] + (cumulative[block - 1] if block > 0 else 0.0)
        while n < last and u >= v:
            n += 1
            v += w[n]
        ancestors[i] = n


@njit_internal
def _last_of_weight(w, first):
    """The last particle of positive weight in the block from ``first`` on; ``first`` if none."""
    last = min(first + BLOCK, w.size) - 1
    while last > first and not w[last] > 0.0:
        last -= 1
    return last


@njit_internal
def choose_in_order(w, order, points, w_ordered, cumulative, ancestors):
    """As `choose_ancestors`, with the particles taken in this order."""
    for i in range(order.size):
        w_ordered[i] = w[order[i]]
    choose_ancestors(w_ordered, points, cumulative, ancestors)
    for i in range(ancestors.size):
        ancestors[i] = order[ancestors[i]]


@njit_internal
def copy_ancestors(X_all, ancestors, X):
    """Set the columns of X (states, particles) to those of their ancestors in X_all."""
    for a in range(X.shape[0]):
        old, row = X_all[a], X[a]
        for i in range(row.size):
            row[i] = old[ancestors[i]]
