"""The plain arrays that a chain's machine code works on, and what their columns mean.

Everything here is data: it is made in Python, changed in machine code, and stored as it is.
"""

from typing import NamedTuple

import numpy as np

from pymc_statespace_filters.compiler.native.pytensor_function import Call

HEALTH_SIZE = 3
# Reasons of a failure that no filter reports: a value that is no density, an exception.
NOT_A_NUMBER, RAISED = -1, -2

# Columns of a chain's numbers, and of the numbers and counts of its draws.
LOG_DENSITY, N_EFFECTIVE, LOG_SCREEN = range(3)
ACCEPTANCE, SCALING = 2, 3
N_NUMBERS = 4
STAGE, N_EVALUATIONS, N_FAILED, FAILURE, N_SCREENED, N_SCREEN_FAILED = range(6)
N_COUNTS = 6
# Cells by which a running chain and whoever waits for it talk.
PAUSE, DONE = range(2)


class Density(NamedTuple):
    """A log-density that machine code can call.

    Attributes
    ----------
    call : Call
        Its results are the log-density, the health of each filter, and the noise it used if the
        chain carries that.
    position : ndarray, shape (d,)
        What the call reads.
    seeds : ndarray of int64, shape (noisy,)
        What the call reads too.
    n_healths : int
    """

    call: Call
    position: np.ndarray
    seeds: np.ndarray
    n_healths: int


class Settings(NamedTuple):
    """What does not change within a phase of a chain, warm-up or sampling."""

    n_stages: int
    stage_scale: float
    screened: bool
    adapts: bool
    continuous: bool
    adapt_every: int


class State(NamedTuple):
    """Where a chain stands: plain arrays, changed in place.

    Attributes
    ----------
    position : ndarray, shape (d,)
        On the unconstrained space.
    seeds : ndarray of int64, shape (noisy,)
        The noise behind the estimate.
    numbers : ndarray, shape (3,)
        Log-density as it was estimated when the chain came here; smallest effective number of
        particles behind it (infinity without noise); log-density of the screen.
    adaptation : ndarray
        What was learnt, see `adaptation_state.unpack`.
    carried : ndarray
        The noise itself, where the chain moves it instead of drawing it anew.
    """

    position: np.ndarray
    seeds: np.ndarray
    numbers: np.ndarray
    adaptation: np.ndarray
    carried: np.ndarray


class Random(NamedTuple):
    """Random numbers of consecutive iterations: the first axis.

    Attributes
    ----------
    normals : ndarray, shape (iterations, stages, d)
        Standard normals, for the proposals.
    log_uniforms : ndarray, shape (iterations, stages + 1)
        Logs of uniforms for acceptance: by stage, and of a screened move.
    seeds : ndarray of int64, shape (iterations, stages, noisy)
        Seeds of the likelihoods' own noise.
    """

    normals: np.ndarray
    log_uniforms: np.ndarray
    seeds: np.ndarray


class Draws(NamedTuple):
    """What is noted down of each iteration: the first axis.

    Attributes
    ----------
    positions : ndarray, shape (n, d)
    numbers : ndarray, shape (n, 4)
        Columns LOG_DENSITY, N_EFFECTIVE, ACCEPTANCE, SCALING.
    counts : ndarray of int64, shape (n, 6)
        Columns STAGE (whose proposal was accepted, 0 if none was), N_EVALUATIONS, N_FAILED, FAILURE
        (the last one's code), N_SCREENED, N_SCREEN_FAILED.
    seeds : ndarray of int64, shape (n, noisy)
    covs : ndarray, shape (n_covs, d, d)
        Covariance of the first stage's proposals, of the first few iterations, or of none.
    """

    positions: np.ndarray
    numbers: np.ndarray
    counts: np.ndarray
    seeds: np.ndarray
    covs: np.ndarray


class Evaluation(NamedTuple):
    """What one evaluation gives.

    Attributes
    ----------
    log_density : float
        Never NaN nor plus infinity; a failed evaluation is minus infinity.
    failure : int
        0, or the code of the reason: a key of ``inspection.FAILURES``, or ``NOT_A_NUMBER``.
    n_effective : float
        Smallest effective number of particles in any filter, infinity without noisy filters.
    """

    log_density: float
    failure: int
    n_effective: float
