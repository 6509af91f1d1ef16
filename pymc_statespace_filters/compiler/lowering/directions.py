"""How many numbers are random in the state, and how many sensors without noise see it.

The counts are upper bounds: equal where a system is not special, and never too small.
"""

from typing import NamedTuple

import numpy as np
import pytensor.tensor as pt
from numpy.typing import NDArray

from ...system.model import StateSpaceModel
from .structure import sources_of_start, still_noises, zeros
from .symbols import observation_moments, symbols_of


class Directions(NamedTuple):
    """Of a state of ``n`` numbers, how many are random at step 0 and how many more by each step.

    ``exact`` (p,) tells which sensors have a variance of zero whatever the parameters.
    """

    n: int
    at_start: int
    per_step: int
    exact: NDArray[np.bool_]


def directions_of(system: StateSpaceModel) -> Directions:
    """Count them; where a number cannot be decided, it is random, and a sensor has noise."""
    symbols = symbols_of(system)
    start = sources_of_start(system, symbols)
    at_start = system.n if start is None else sum(map(bool, start))
    per_step = system.m - len(still_noises(system, symbols))
    exact = np.zeros(system.p, dtype=bool)
    if system.gaussian_observation:
        exact[:] = zeros(pt.diagonal(observation_moments(system, symbols)[1]), symbols)
    return Directions(system.n, at_start, per_step, exact)
