"""The loop of every filter with members along a record: start, advance, observe.

Members are columns of X with log weights: states of the system, or whatever else the functions of
the filter make of a column. Noise of a step is a function of seed, step and member, so that a
filter that goes on from a state has the bits of one run over all rows.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ...compiler.native.borrowed import borrowed
from ...compiler.native.cache_key import is_outside
from ...compiler.native.entry_point import EntryPoint
from ...compiler.native.jit import inline_always, njit_internal
from ...compiler.numerics.normals import FILL_NORMALS
from ...errors import ModelError
from ..calls import OK, likelihood_entry
from ..outcomes import EXCEPTION, NONE, NOT_A_NUMBER, OUT_OF_MEMORY, is_missing
from ..plan import PLAN, initialise, propagate
from .callbacks import ENDED, FORECAST, RESAMPLED, UPDATED, emit
from .evaluation import Members, leave, members_of, read_evaluation, show
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
def updated(increment):
    """The outcome of an update of a single part."""
    return Outcome(increment, np.inf, np.inf, NONE)


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
    k, members = members_of(call)
    if k < 0:
        k = np.int64(0)
        initialise(call.system, initial_normals(call.noise), call.local.width, members.X)
        show(call, FORECAST, -1, k, members, call.nothing)
    return k, Plain(members)


@njit_internal
def advance(call, j, k, last, parts):
    """Move the members from step k to the last one before, or at, row j."""
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
    observe : numba function ``(call, j, k, parts) -> Outcome``
        Replaces the forecast members by the analysis of observation j at step k, with normalised
        weights. ``call`` is an `Evaluation`. What it returns, and where it branches, is the same on
        all ranks. It raises nothing. Arrays of ``call`` and ``parts`` live until the record ends.
    start : numba function ``call -> (k, parts)``, optional
        Draws the members at step 0, or takes those of a state. ``parts`` is a named tuple with
        ``members``, a `Members`, and what else the other functions need.
    advance : numba function ``(call, j, k, last, parts)``, optional
        Moves members from step k to the step ``last`` of row j.
    resample : numba function ``(call, j, k, n_weighted, parts) -> bool``, optional
        Whether members were resampled.

    Returns
    -------
    EntryPoint
        Writes ``terms``, ``n_effective`` of every term, which stays NaN where there is none, and
        ``health`` (see `filters.protocol`).

    Raises
    ------
    ModelError
        If one of them is no numba function of these arguments; by the first evaluation, if numba
        cannot compile it, or it returns something else.
    """
    functions = {"start": start, "advance": advance, "observe": observe, "resample": resample}
    for role, function in functions.items():
        _check_function(name, role, function)
    # Where machine code raises, nothing but what was written before is left.
    if_raised = EXCEPTION if any(map(is_outside, functions.values())) else OUT_OF_MEMORY

    @njit_internal
    def follow_rows(call, k, parts, origins, to):
        # The caller keeps the arrays. Counting references to them can take a tenth of the time.
        call, parts, origins, to = borrowed((call, parts, origins, to))
        members, observer, nothing = parts.members, call.observer, call.nothing
        record, local, health = call.record, call.local, to.health
        steps, ancestors = record.steps, call.resampling.ancestors
        for j in range(steps.size):
            health[2] = j
            if k < steps[j]:
                advance(call, j, k, steps[j], parts)
                k = steps[j]
            if is_missing(record.observed, j):
                to.terms[j] = 0.0
                continue
            found = observe(call, j, k, parts)
            failure = found.failure
            if failure == NONE and not np.isfinite(found.increment):
                failure = NOT_A_NUMBER
            n_effective = np.inf if local.n_members == 1 else found.n_effective
            if origins.own.size and failure == NONE:
                n_distinct = effective_number_of_origins(origins, members.w, local)
                n_effective = min(n_effective, n_distinct)
            to.n_effective[j] = n_effective
            health[0] = min(health[0], n_effective)
            if failure != NONE:
                health[1], health[2] = failure, j
                return
            to.terms[j] = found.increment
            emit(observer, UPDATED, j, k, members, record.observed[j], ancestors)
            if resample(call, j, k, found.n_weighted, parts):
                follow_ancestors(origins, ancestors)
                emit(observer, RESAMPLED, j, k, members, nothing, ancestors)
        emit(observer, ENDED, steps.size, k, members, nothing, ancestors)
        if to.state.size:
            leave(k, members, local, to.state)
        health[1], health[2] = NONE, -1

    @njit_internal
    def evaluate(plan, record, request, seed, to):
        call, status = read_evaluation(plan, record, request, seed)
        if status != OK:
            return status
        local, health = call.local, to.health
        health[0] = np.inf if local.n_members == 1 else local.n_members
        health[1], health[2] = if_raised, 0
        if to.state.size:
            to.state[:] = np.nan
        if call.system.failure != NONE:
            health[0], health[1], health[2] = 0.0, call.system.failure, 0.0
            return OK
        origins = new_origins(plan[PLAN.follows_origins] != 0, local)
        k, parts = start(call)
        follow_rows(call, k, parts, origins, to)
        return OK

    return likelihood_entry(name, evaluate, tuple(functions.values()), needs=(FILL_NORMALS,))


_N_ARGUMENTS = {"start": 1, "advance": 5, "observe": 4, "resample": 5}


def _check_function(name: str, role: str, function: Any) -> None:
    """Raise unless it is a numba function of so many arguments, in which no division raises."""
    given, count = getattr(function, "py_func", None), _N_ARGUMENTS[role]
    is_right = given is not None and given.__code__.co_argcount == count
    if not is_right or function.targetoptions.get("error_model") != "numpy":
        raise ModelError(
            f"{role} of the filter {name!r} must be a function of {count} arguments, see "
            f'member_filter, with the decorator numba.njit(error_model="numpy"), got {function!r}'
        )
