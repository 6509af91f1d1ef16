"""The loop of every filter with members along a record: start, advance, observe.

Members are columns of X with log weights: states of the system, or whatever else the functions of
the filter make of a column. Noise of a step is a function of seed, step and member, so that a
filter that goes on from a state has the bits of one run over all rows.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...compiler.native.entry_point import EntryPoint
from ...compiler.native.jit import inline_always, njit_internal
from ...compiler.numerics.normals import FILL_NORMALS
from ..calls import OK, likelihood_entry
from ..outcomes import NONE, is_missing
from ..plan import PLAN, initialise, propagate
from .callbacks import ENDED, FORECAST, RESAMPLED, UPDATED, emit
from .evaluation import Members, leave, new_members, read_evaluation, restore, show
from .noise import initial_normals, process_normals, resampling_normals
from .origins import effective_number_of_origins, follow_ancestors, new_origins
from .resampling import resample_if_few


class Outcome(NamedTuple):
    """What `observe` returns.

    ``increment`` is log p(d_j | d_1 .. d_{j-1}), the log of a mean, and ``n_effective`` the
    effective number of the weights of that mean: below a few, one member decides the increment.
    ``n_weighted`` is the effective number of the weights that the update has left the members,
    which decides whether to resample. ``failure`` is a code of `filters.outcomes`.
    """

    increment: float
    n_effective: float
    n_weighted: float
    failure: int


@inline_always
def failed(failure, n_effective=0.0):
    """The outcome of an update that has failed."""
    return Outcome(-np.inf, n_effective, 0.0, failure)


class Plain(NamedTuple):
    """The parts of a filter that has nothing but members."""

    members: Members


@njit_internal
def start(call):
    """Draw the members at step 0, or take those of a state; the step, and the parts."""
    members = new_members(call.system.n, call.system.p, call.local)
    if call.state.size:
        return restore(call, members), Plain(members)
    initialise(call.system, initial_normals(call.noise), call.local.width, members.X)
    show(call, FORECAST, -1, np.int64(0), members, call.nothing)
    return np.int64(0), Plain(members)


@njit_internal
def advance(call, j, k, last, parts):
    """Move the members from step k to the last one before, or at, row j."""
    # Taken out of their tuples before the loop, which would count references at every step.
    system, noise, members, X = call.system, call.noise, parts.members, parts.members.X
    observer, nothing, ancestors = call.observer, call.nothing, call.resampling.ancestors
    t0, dt, width = call.record.t0, system.dt, call.local.width
    while k < last:
        propagate(system, k, t0 + k * dt, process_normals(noise, k), width, X)
        k += 1
        emit(observer, FORECAST, j, k, members, nothing, ancestors)


@njit_internal
def resample(call, j, k, n_weighted, parts):
    """Resample if few members have the weight; whether that was so."""
    members, z = parts.members, resampling_normals(call.noise, j, k)
    return resample_if_few(
        call.resampling, n_weighted, z, members.log_w, members.w, members.X, call.local
    )


def member_filter(
    name: str,
    observe: Callable,
    *,
    start: Callable = start,
    advance: Callable = advance,
    resample: Callable = resample,
) -> EntryPoint:
    """Make a filter one compiled function for all systems and numbers of members.

    Parameters
    ----------
    name : str
    observe : njit function ``(call, j, k, parts) -> Outcome``
        Replaces the forecast members by the analysis of observation j at step k, with normalised
        weights. ``call`` is an `Evaluation`. What it returns, and where it branches, is the same on
        all ranks.
    start : njit function ``call -> (k, parts)``, optional
        Draws the members at step 0, or takes those of a state. ``parts`` is a named tuple with
        ``members``, a `Members`, and what else the other functions need.
    advance : njit function ``(call, j, k, last, parts)``, optional
        Moves members from step k to the step ``last`` of row j.
    resample : njit function ``(call, j, k, n_weighted, parts) -> bool``, optional
        Whether members were resampled.

    Returns
    -------
    EntryPoint
        Writes ``terms``, ``n_effective`` of every term, which stays NaN where there is none, and
        ``health`` (see `filters.protocol`).
    """

    @njit_internal
    def evaluate(plan, record, request, seed, to):
        call, status = read_evaluation(plan, record, request, seed)
        if status != OK:
            return status
        steps, local, health = record.steps, call.local, to.health
        health[0], health[1], health[2] = local.n_members, NONE, -1
        if to.state.size:
            to.state[:] = np.nan
        if call.system.failure != NONE:
            health[0], health[1], health[2] = 0.0, call.system.failure, 0.0
            return OK
        origins = new_origins(plan[PLAN.follows_origins] != 0, local)
        k, parts = start(call)
        members, observer, nothing = parts.members, call.observer, call.nothing
        ancestors = call.resampling.ancestors
        for j in range(steps.size):
            if k < steps[j]:
                advance(call, j, k, steps[j], parts)
                k = steps[j]
            if is_missing(record.observed, j):
                to.terms[j] = 0.0
                continue
            found = observe(call, j, k, parts)
            n_effective = found.n_effective
            if origins.own.size and found.failure == NONE:
                n_distinct = effective_number_of_origins(origins, members.w, local)
                n_effective = min(n_effective, n_distinct)
            to.n_effective[j] = n_effective
            health[0] = min(health[0], n_effective)
            if found.failure != NONE:
                health[1], health[2] = found.failure, j
                return OK
            to.terms[j] = found.increment
            emit(observer, UPDATED, j, k, members, record.observed[j], ancestors)
            if resample(call, j, k, found.n_weighted, parts):
                follow_ancestors(origins, ancestors)
                emit(observer, RESAMPLED, j, k, members, nothing, ancestors)
        emit(observer, ENDED, steps.size, k, members, nothing, ancestors)
        if to.state.size:
            leave(k, members, local, to.state)
        return OK

    return likelihood_entry(
        name, evaluate, (start, advance, observe, resample), needs=(FILL_NORMALS,)
    )
