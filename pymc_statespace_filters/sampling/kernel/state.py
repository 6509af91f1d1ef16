"""Arrays that the machine code of a chain reads and writes, and the meaning of their columns.

They are made in Python, changed in place by machine code, and stored as they are in a checkpoint.
"""

from typing import NamedTuple

import numpy as np

from pymc_statespace_filters.compiler.native.pytensor_function import Call
from pymc_statespace_filters.filters.outcomes import FAILURES
from pymc_statespace_filters.sampling.kernel.adaptation_state import unpack

HEALTH_SIZE = 3
# Failure codes that no filter reports: a log-density of NaN or plus infinity, an exception.
NOT_A_NUMBER, RAISED = -1, -2

# Columns of a chain's numbers, and of the numbers and counts of its draws.
LOG_DENSITY, N_EFFECTIVE, LOG_SCREEN = range(3)
ACCEPTANCE, SCALING = 2, 3
N_NUMBERS = 4
STAGE, N_EVALUATIONS, N_FAILED, FAILURE, N_SCREENED, N_SCREEN_FAILED = range(6)
N_COUNTS = 6
# Cells of the control block that a running chain shares with the main thread.
PAUSE_REQUESTED, N_DONE = range(2)


class NativeLogDensity(NamedTuple):
    """A log-density as machine code calls it.

    Attributes
    ----------
    call : Call
        Its results are the log-density, the health of each filter, and the noise it used if the
        chain carries its noise.
    position : ndarray, shape (d,)
        Read by the call.
    seeds : ndarray of int64, shape (noisy,)
        Read by the call.
    n_healths : int
    """

    call: Call
    position: np.ndarray
    seeds: np.ndarray
    n_healths: int


class PhaseSettings(NamedTuple):
    """Settings that are constant within a phase of a chain, warm-up or sampling."""

    n_stages: int
    stage_scale: float
    screened: bool
    adapts: bool
    continuous: bool
    adapt_every: int


class ChainState(NamedTuple):
    """The state of a chain: plain arrays, changed in place.

    Attributes
    ----------
    position : ndarray, shape (d,)
        On the unconstrained space.
    seeds : ndarray of int64, shape (noisy,)
        Noise seeds of the estimate.
    numbers : ndarray, shape (3,)
        Log-density as estimated when the point was accepted; smallest effective number of particles
        of the estimate (infinity without noise); log-density of the screen.
    adaptation : ndarray
        State of the adaptation, see `adaptation_state.unpack`.
    carried : ndarray
        The noise itself, if proposals are correlated with it.
    key : ndarray of uint64, shape (2,)
        Key of the chain's random numbers.
    """

    position: np.ndarray
    seeds: np.ndarray
    numbers: np.ndarray
    adaptation: np.ndarray
    carried: np.ndarray
    key: np.ndarray

    @property
    def proposal_cov(self) -> np.ndarray:
        """Covariance of the first stage's proposals, shape (d, d)."""
        return unpack(self.adaptation, self.position.size).cov


class RandomBlock(NamedTuple):
    """Random numbers of consecutive iterations, along the first axis.

    Attributes
    ----------
    normals : ndarray, shape (iterations, stages, d)
        Standard normals, for the proposals.
    log_uniforms : ndarray, shape (iterations, stages + 1)
        Logs of uniforms for acceptance: of each stage, and of a screened move.
    seeds : ndarray of int64, shape (iterations, stages, noisy)
        Noise seeds of the estimated likelihoods.
    """

    normals: np.ndarray
    log_uniforms: np.ndarray
    seeds: np.ndarray


class Draws(NamedTuple):
    """Record of the iterations of a chain, along the first axis.

    Attributes
    ----------
    positions : ndarray, shape (n, d)
    numbers : ndarray, shape (n, 4)
        Columns LOG_DENSITY, N_EFFECTIVE, ACCEPTANCE, SCALING.
    counts : ndarray of int64, shape (n, 6)
        Columns STAGE (whose proposal was accepted, 0 if none was), N_EVALUATIONS, N_FAILED, FAILURE
        (the last failure code), N_SCREENED, N_SCREEN_FAILED.
    seeds : ndarray of int64, shape (n, noisy)
    covs : ndarray, shape (n_covs, d, d)
        Covariance of the first stage's proposals, in the first iterations only.
    """

    positions: np.ndarray
    numbers: np.ndarray
    counts: np.ndarray
    seeds: np.ndarray
    covs: np.ndarray


class Evaluation(NamedTuple):
    """Result of one evaluation of a log-density.

    Attributes
    ----------
    log_density : float
        Never NaN or plus infinity; minus infinity after a failure.
    failure : int
        0, or the failure code: a key of ``outcomes.FAILURES``, or ``NOT_A_NUMBER``.
    n_effective : float
        Smallest effective number of particles in any filter, infinity without noisy filters.
    """

    log_density: float
    failure: int
    n_effective: float


def failure_reason(code: int) -> str:
    """Describe a failure code in words."""
    if code == NOT_A_NUMBER:
        return "the log-density is NaN or plus infinity"
    return FAILURES.get(code, f"failure {code}")
