"""Optional callback of an ensemble filter, run after each forecast, update and resampling.

A callback is an entry point with two vectors, one of integers and one of reals, which it reads and
writes. Smoothers, summaries of states and stored particles are callbacks; a likelihood-only run
passes a null address. A function of states is an entry point that runs the filter of its plan with
its callback, and makes results of what that wrote.
"""

import numpy as np
from numba import types

from ...compiler.native.entry_point import (
    F64_PTR,
    I64_PTR,
    arguments_class,
    call_address,
    call_for_status,
)
from ...compiler.native.jit import keep_alive, njit_internal
from ...compiler.native.plan import HEALTH_SIZE, N_RESULTS, RECORD, REQUEST, RESULTS
from ..plan import PLAN

FORECAST, PREDICTED, UPDATED, RESAMPLED, ENDED = (np.int64(event) for event in range(5))
"""Events at step k: members were initialised or moved there from step k - 1; if they were guided by
later observations, copies of them were moved without it since the last one; an observation has
updated members and weights; members were resampled (``ancestors`` tells from which); the record has
ended."""

CALLBACK_ARGUMENTS = {
    "integers": I64_PTR, "reals": F64_PTR,  # vectors of the callback
    "event": types.int64, "j": types.int64, "k": types.int64,  # event, observation, step
    "X": F64_PTR, "log_w": F64_PTR,  # members (n, N) and their log weights (N,)
    "d": F64_PTR, "D": F64_PTR,  # observation (p,) and simulated ones (p, N), if updated
    "ancestors": I64_PTR,  # (N,), if resampled
}  # fmt: skip

CallbackArguments = arguments_class("CallbackArguments", CALLBACK_ARGUMENTS, __name__)


@njit_internal
def emit(callback, event, j, k, members, d, ancestors):
    """Call the callback, if there is one."""
    address, integers, reals = callback
    if address != 0:
        arguments = CallbackArguments(
            integers=integers, reals=reals, event=event, j=np.int64(j), k=k, X=members.X,
            log_w=members.log_w, d=d, D=members.D, ancestors=ancestors,
        )  # fmt: skip
        call_address(address, arguments)


@njit_internal
def run_observed(call, plan, record, integers, reals):
    """Run the filter of a plan with its callback; a status, terms and health."""
    request, results = call.request.copy(), np.zeros(N_RESULTS, np.int64)
    request[REQUEST.observer] = call.plan[PLAN.observer]
    request[REQUEST.observer_integers] = integers.ctypes.data
    request[REQUEST.observer_reals] = reals.ctypes.data
    terms, health = np.empty(call.record[RECORD.n_rows]), np.empty(HEALTH_SIZE)
    results[RESULTS.terms], results[RESULTS.health] = terms.ctypes.data, health.ctypes.data
    results[RESULTS.state] = call.results[RESULTS.state]
    status = call_for_status(call.plan[PLAN.evaluate], (plan, record, request, results))
    keep_alive(integers)
    keep_alive(reals)
    return status, terms, health


@njit_internal
def searchsorted(rows, k, first):
    """Index of the first of increasing rows, from ``first`` on, that is not before step k."""
    place = first
    while place < rows.size and rows[place] < k:
        place += 1
    return place
