"""From which particle of the start each particle stems: copies of one are told apart by noise only.

Of a system with states that no noise reaches, resampled particles stay equal in these states, and
equal weights hide how few different ones are left.
"""

from typing import NamedTuple

import numpy as np

from ...compiler.native.jit import njit_internal
from .reductions import MEMBERS, allgather


class Origins(NamedTuple):
    """The origins of this rank's particles; all arrays are empty where they are not followed.

    ``gathered`` (2, N) holds the weights and origins of the particles of all ranks, ``total`` (N,)
    the weight of each origin.
    """

    own: np.ndarray
    gathered: np.ndarray
    total: np.ndarray


@njit_internal
def new_origins(are_followed, local):
    """Every particle is its own."""
    n, n_all = (local.size, local.n_members) if are_followed else (0, 0)
    own = np.empty(n)
    for i in range(n):
        own[i] = local.first + i
    return Origins(own, np.empty((2, n_all)), np.empty(n_all))


@njit_internal
def effective_number_of_origins(origins, w, local):
    """1 / sum W^2 of the weights W of all particles of one origin (thesis, Eq. 4.43)."""
    own, gathered, total = origins
    for i in range(own.size):
        gathered[0, local.first + i], gathered[1, local.first + i] = w[i], own[i]
    allgather(local.layout, gathered, MEMBERS)
    total[:] = 0.0
    for i in range(total.size):
        total[int(gathered[1, i])] += gathered[0, i]
    squares = 0.0
    for weight in total:
        squares += weight * weight
    return 1.0 / squares


@njit_internal
def follow_ancestors(origins, ancestors):
    """Take the origins of the particles that were copied, all of which have been gathered."""
    for i in range(origins.own.size):
        origins.own[i] = origins.gathered[1, ancestors[i]]
