"""A system of one state as the point-mass filter sees it: functions called by their address."""

import math
from typing import NamedTuple

import numpy as np

from pymc_statespace_filters.compiler.native.entry_point import call_address
from pymc_statespace_filters.compiler.native.jit import inline_always
from pymc_statespace_filters.filters.ensemble.system_table import NOTHING, call_members


class OneStateSystem(NamedTuple):
    """One evaluation's system: the functions are those of ``lowering.OneState``.

    ``c`` are the parameters, ``inputs`` a row for each step. The state starts from a Gaussian of
    this ``mean`` and ``sd``.
    """

    dt: float
    same_every_step: bool
    c: np.ndarray
    inputs: np.ndarray
    is_valid: bool
    mean: float
    sd: float
    move: int
    log_density: int


@inline_always
def read_one_state(start, move, log_density, dt, same_every_step, theta, inputs):
    """Give names to what the entry of the filter was called with, and ask for the start."""
    first = np.zeros(3)
    call_address(start, (theta, theta.size, first))
    is_valid, mean, sd = first[0] != 0.0, first[1], math.sqrt(first[2])
    return OneStateSystem(
        dt, same_every_step != 0, theta, inputs, is_valid, mean, sd, move, log_density
    )


@inline_always
def move_points(system, k, t, X, M):
    """Write the mean and the variance of the state one step later, for each point."""
    call_members(system.move, system, k, t, NOTHING, NOTHING, X, M)
