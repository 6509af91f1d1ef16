"""The pilot of a guided filter: plain particles that find out where the guide is wrong.

A guide follows one explanation of the record. Where there is another one, such as the other sign
behind a sensor of ``abs(x)``, it leads all particles past it. Plain particles reach both. The pilot
moves some along the record, without the guide but with the density ratio that every move would
have under it, and asks for each interval about the paths that still have descendants a few
observations later:

* How rare would the path be among guided particles? Its weight is the density of its noise over
  that under the guide, over psi where it begins.
* Is it as good as the guide's own path? In a linear system the weight of an interval, times psi
  behind it, over psi before it, is the same number for all paths: the factor of the evidence. What
  a path has in excess of that, over the intervals up to its descendants, the guide has left out.

A path that is rare and good is missed; one that is only rare lags behind a surprise which the guide
saw coming. The share of particles that the filter leaves unguided in the interval is the one of
least variance of the weights, if the smoothed state is distributed as these paths.

Where the sensor folds, two explanations may last for the whole record, and the pilot, whose
particles are resampled, may lose one of them within a few observations. So it asks another question
of pairs of its particles: does a state halfway between them explain the observation far worse than
either? It does not if the sensor is monotone. If it does for several pairs, the guide is trusted
nowhere: the largest share holds in all intervals.

The pilot has noise of its own, which depends on nothing: the guide remains a function of the record
and the parameters, the same on every rank and for stored normals. Nothing else of it is used: an
estimate that looked at the pilot's would not be unbiased.
"""

import math
from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import copy_into, njit_internal
from ...compiler.numerics.exponential import exp
from ...compiler.numerics.normals import BLOCK
from ...compiler.numerics.philox import PILOT
from ..outcomes import is_missing
from ..plan import log_density
from .defence import LEAST_SHARE
from .evaluation import Evaluation, n_sums, new_members, time_of
from .guided_moves import begin_interval, draw_start, guided_particles, log_psi, move
from .kalman_update import copy_members
from .loop import Plain
from .noise import NoiseSizes, noise_of, resampling_normals
from .reductions import RankLayout, local_partition
from .resampling import (
    choose_ancestors,
    copy_ancestors,
    gather_particles,
    resample,
    resampler,
)

_N = 2 * BLOCK  # particles
_LAG = 4  # observations until the descendants of a path count
_LENGTH = _LAG + 1
_SHARES = (0.0, LEAST_SHARE, 0.3, 0.5, 0.7, 0.9)
_ENOUGH, _LOG_ENOUGH = 1.2, 0.18  # times the least variance
_VALLEY = 2.0  # nats by which the sensor must be worse halfway between two particles
_FOLDED = 4  # pairs, of N / 2, between which the sensor folds, and not by the chance of a tail
_SEED = 0


class Paths(NamedTuple):
    """Moves of the particles over the last L intervals, in rings by number of observation.

    ``rarity`` and ``excess`` (L, N) are the two logs of the module's docstring, ``lineage`` (L, N)
    the ancestor of each particle in the last interval and those before. ``rows`` (L,) says where an
    interval begins in the record, ``gain`` (L,) by how much the particles explain its observation
    better than the guide does. ``missed`` and ``descendants`` (N,) belong to one interval.
    """

    rarity: np.ndarray
    excess: np.ndarray
    lineage: np.ndarray
    rows: np.ndarray
    gain: np.ndarray
    missed: np.ndarray
    descendants: np.ndarray


@njit_internal
def _paths():
    return Paths(
        rarity=np.empty((_LENGTH, _N)), excess=np.empty((_LENGTH, _N)),
        lineage=np.empty((_LENGTH, _N), np.int64), rows=np.empty(_LENGTH, np.int64),
        gain=np.empty(_LENGTH), missed=np.empty(_N), descendants=np.empty(_N),
    )  # fmt: skip


@njit_internal
def chosen_for_pilot(w, X, local):
    """States (n, 128) among weighted particles of all ranks, at even distances of their weights."""
    every, X_pilot = np.empty((1 + X.shape[0], local.n_members)), np.empty((X.shape[0], _N))
    points, ancestors = (np.arange(_N) + 0.5) / _N, np.empty(_N, np.int64)
    gather_particles(w, X, local, every)
    choose_ancestors(every[0], points, np.empty(local.sums.shape[1]), ancestors)
    copy_ancestors(every[1:], ancestors, X_pilot)
    return X_pilot


@njit_internal
def judge(call, guide, observe, k, X, shares):
    """Write the share of unguided particles in every interval that begins behind an observation.

    ``observe`` is that of `bootstrap`. The pilot begins at step k with the states X (n, 128), or
    where there are none at step 0 with draws.
    """
    system, record, none = call.system, call.record, np.int64(0)
    steps = record.steps
    local = local_partition(RankLayout(0, 1, 0), np.int64(_N), n_sums(system))
    sizes = NoiseSizes(_N, system.n, system.m, 0, BLOCK)
    n_steps = steps[-1] if steps.size else none
    noise = noise_of(np.int64(_SEED), np.empty(0), sizes, n_steps, none, PILOT)
    resampling = resampler(1.0, 0, none, system.n, local)
    pilot = Evaluation(
        plan=call.plan, system=system, record=record, state=call.nothing, settings=call.settings,
        n_rows=call.n_rows, noise=noise, local=local, resampling=resampling,
        observer=(none, none, none), nothing=call.nothing,
    )  # fmt: skip
    members, before, paths = new_members(system.n, system.p, local), np.zeros(_N), _paths()
    particles = guided_particles(pilot, members, guide, call.nothing)
    particles.unguided[:], particles.ahead[0] = True, 1.0
    if X.shape[1] == 0:
        draw_start(pilot, guide, 1.0, particles)
    else:
        copy_members(X, members.X)
        log_psi(particles, none, k, X, before)
    first = seen = none
    for j in range(steps.size):
        move(pilot, k, steps[j], particles)
        k = steps[j]
        if is_missing(record.observed, j):
            continue
        found = observe(pilot, j, k, Plain(members))
        if found.failure:
            break
        log_psi(particles, j + 1, k, members.X, particles.log_v)
        _record_moves(paths, seen, before, particles, found.increment, guide.sums[first, 1])
        paths.rows[seen % _LENGTH] = first
        resample(resampling, resampling_normals(noise, j, k), members.w, members.X, local)
        if _folds(pilot, j, k, members):
            for i in range(steps.size):
                shares[i] = _SHARES[-1]
            return
        _follow_lineage(paths, seen, resampling.ancestors)
        for i in range(_N):
            before[i] = particles.log_v[resampling.ancestors[i]]
            members.log_w[i] = -math.log(_N)
        begin_interval(particles)
        first, seen = np.int64(j + 1), seen + 1
        if seen >= _LENGTH:
            shares[paths.rows[seen % _LENGTH]] = _share(paths, seen, np.int64(_LAG))
    for back in range(_LAG):
        if back < seen:
            shares[paths.rows[(seen - 1 - back) % _LENGTH]] = _share(paths, seen, np.int64(back))


@njit_internal
def _folds(call, j, k, members):
    """Whether the sensor folds between resampled particles."""
    ancestors, d = call.resampling.ancestors, call.record.observed[j]
    X, half, n_folds = members.X, _N // 2, 0
    between, log_p = np.empty(X.shape), np.empty(_N)
    for a in range(X.shape[0]):
        for i in range(_N):
            between[a, i] = 0.5 * (X[a, i] + X[a, (i + half) % _N])
    log_density(call.system, k, time_of(call, k), d, between, log_p)
    for i in range(half):
        worse = min(members.log_p[ancestors[i]], members.log_p[ancestors[i + half]])
        n_folds += log_p[i] < worse - _VALLEY
    return n_folds >= _FOLDED


@njit_internal
def _record_moves(paths, seen, before, particles, increment, evidence):
    """Enter the moves of an interval; ``before`` is log psi where they began."""
    row, members, log_det = seen % _LENGTH, particles.members, particles.log_det[0]
    rarity, excess, largest, total = paths.rarity[row], paths.excess[row], -np.inf, 0.0
    paths.gain[row] = increment - evidence
    for i in range(_N):
        largest = max(largest, before[i])
    for i in range(_N):
        total += exp(before[i] - largest)
    mean = largest + math.log(total / _N)
    for i in range(_N):
        weight = members.behind[i] + log_det - before[i]
        rarity[i] = weight + mean
        excess[i] = weight + members.log_p[i] + particles.log_v[i] - evidence


@njit_internal
def _follow_lineage(paths, seen, ancestors):
    """Move lineages on to particles that have been resampled."""
    for back in range(min(_LAG, seen), 0, -1):
        for i in range(_N):
            paths.lineage[back, i] = paths.lineage[back - 1, ancestors[i]]
    copy_into(paths.lineage[0], ancestors)


@njit_internal
def _share(paths, seen, back):
    """The share of unguided particles in the interval so many observations ago."""
    missed, gain, most = paths.missed, 0.0, -np.inf
    paths.descendants[:] = 0.0
    for ago in range(back + 1):
        gain += paths.gain[(seen - 1 - ago) % _LENGTH]
    for i in range(_N):
        first = paths.lineage[back, i]
        paths.descendants[first] += 1.0
        missed[i] = paths.rarity[(seen - 1 - back) % _LENGTH, first]
        if missed[i] > _LOG_ENOUGH:
            missed[i] = min(missed[i], _largest_excess(paths, seen, back, i))
        most = max(most, missed[i])
    if not most > _LOG_ENOUGH:
        return 0.0
    return _best_share(paths, back, 1.0 / (1.0 + exp(-gain)))


@njit_internal
def _largest_excess(paths, seen, back, i):
    """The largest excess of a path, from so many observations ago up to any later one."""
    total, largest = 0.0, -np.inf
    for ago in range(back, -1, -1):
        total += paths.excess[(seen - 1 - ago) % _LENGTH, paths.lineage[ago, i]]
        largest = max(largest, total)
    return largest


@njit_internal
def _best_share(paths, back, probability):
    """The smallest share whose weights vary little more than with any other.

    With this ``probability`` the state is on one of the paths, else where the guide leads it.
    """
    among_guided, variances, least = paths.missed, np.empty(len(_SHARES)), np.inf
    for i in range(_N):
        among_guided[i] = exp(-paths.missed[i])
    for s in range(len(_SHARES)):
        share, variance = _SHARES[s], 0.0
        for i in range(_N):
            among_plain = 1.0 / paths.descendants[paths.lineage[back, i]]
            variance += 1.0 / (share * among_plain + (1.0 - share) * among_guided[i])
        variances[s] = probability * variance / _N + (1.0 - probability) / (1.0 - share)
        least = min(least, variances[s])
    for s in range(len(_SHARES)):
        if variances[s] <= _ENOUGH * least:
            return _SHARES[s]
    return _SHARES[-1]
