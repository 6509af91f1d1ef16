"""Why no member of an ensemble takes an observation; asked only after an update has failed."""

from ...compiler.native.jit import njit_internal
from ..observation_failures import mark_defined
from ..outcomes import LARGEST, OBSERVATION_UNDEFINED, STATE_NOT_FINITE, ZERO_DENSITY
from .reductions import count


@njit_internal
def failure_of_all(system, k, t, d, members, local):
    """What is wrong at every member: its state, its observation, or that it is not this one.

    ``alive`` are those that have finite states and a weight.
    """
    X, alive = members.X, members.alive
    for a in range(system.n):
        for i in range(alive.size):
            alive[i] &= abs(X[a, i]) < LARGEST
    if count(alive, local) == 0.0:
        return STATE_NOT_FINITE
    mark_defined(system, k, t, d, X, members.log_p, alive)
    return OBSERVATION_UNDEFINED if count(alive, local) == 0.0 else ZERO_DENSITY
