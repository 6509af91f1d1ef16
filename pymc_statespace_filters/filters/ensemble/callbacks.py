"""Who watches an ensemble filter at work: called at every event, with the members of that moment.

A witness is an entry, found by its address, with two vectors of its own, one of whole numbers and
one of real ones: what it reads and what it writes.
So what is to be known of the states (moments, a draw, all members for a smoother) is no matter of
the filters, and whoever wants the likelihood alone has no witness and pays nothing.
"""

import numpy as np
from numba import types

from pymc_statespace_filters.compiler.native.entry_point import F64_PTR, I64_PTR, call_address
from pymc_statespace_filters.compiler.native.jit import inline_always, njit_contract

FORECAST, UPDATED, RESAMPLED, ENDED = (np.int64(event) for event in range(4))
"""Events at step k: members are there (at step 0, or moved there from step k - 1), an observation
has updated members and weights, members have been resampled (``ancestors`` tells from whom), the
record is over."""

NO_CALLBACK = (0, 0, 0)
"""No witness."""

CALLBACK_ARGUMENTS = (
    I64_PTR, F64_PTR,  # the witness's own
    types.int64, types.int64, types.int64,  # event, observation, step
    F64_PTR, F64_PTR,  # X (n, N), log_w (N,)
    F64_PTR, F64_PTR,  # the observation (p,) and D (p, N), to be read when updated alone
    I64_PTR,  # ancestors (N,), to be read when resampled alone
)  # fmt: skip


@inline_always
def emit(with_callback, event, j, k, members, d, ancestors):
    """Call the witness, if there is one."""
    witness, counts, numbers = with_callback
    if witness != 0:
        arguments = (
            counts, numbers, event, np.int64(j), k,
            members.X, members.log_w, d, members.D, ancestors,
        )  # fmt: skip
        call_address(witness, arguments)


@njit_contract
def searchsorted(k, rows, first):
    """The first of increasing rows, from number ``first`` on, that is not before step k."""
    place = first
    while place < rows.size and rows[place] < k:
        place += 1
    return place
