"""Arrays that the machine code of a chain reads and writes, and its random numbers.

They are made in Python, changed in place by machine code, and stored as they are in a checkpoint.

One call of a generator costs microseconds whether it returns one number or a thousand. A block of
numbers is a function of the chain's key and the block's index, so that a chain can be resumed at
any iteration, on any rank.
"""

from typing import NamedTuple

import numpy as np

from ...compiler.native.pytensor_function import Call
from ...statistics.student_mixture import DEGREES_OF_FREEDOM
from .adaptation_state import unpack

HEALTH_SIZE = 3

# Columns of a chain's numbers, and of the numbers and counts of its draws.
LOG_DENSITY, N_EFFECTIVE, LOG_SCREEN = range(3)
ACCEPTANCE, SCALING = 2, 3
N_NUMBERS = 4
STAGE, N_EVALUATIONS, N_FAILED, FAILURE, N_SCREENED, N_SCREEN_FAILED, INDEPENDENT = range(7)
N_ACCEPTED = 7
N_COUNTS = 8
# If records are moved one by one, the counts of a draw have more columns: what each record has
# accepted, then what the blocks of the shared parameters and of the population have.
N_COMMON_BLOCKS = 2
# Cells of the control block that a running chain shares with the main thread.
PAUSE_REQUESTED, N_DONE = range(2)

BLOCK = 256


class NativeLogDensity(NamedTuple):
    """A log-density as machine code calls it, and the arrays that the call reads."""

    # Returns the log-density, the health of each filter, and the noise if the chain carries it.
    call: Call
    position: np.ndarray  # (d,)
    seeds: np.ndarray  # int64 (noisy,)
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

    Its numbers are the log-density as estimated when the point was accepted, the smallest effective
    number of particles of the estimate (infinity without noise), and the log-density of the screen.
    """

    position: np.ndarray  # (d,), on the unconstrained space
    seeds: np.ndarray  # int64 (noisy,), of the estimate
    numbers: np.ndarray  # (3,), columns LOG_DENSITY, N_EFFECTIVE, LOG_SCREEN
    adaptation: np.ndarray  # packed, see `adaptation_state.unpack`
    mixture: np.ndarray  # packed, see `independence.unpack_mixture`
    carried: np.ndarray  # the noise itself, if proposals are correlated with it
    key: np.ndarray  # uint64 (2,), of the chain's random numbers

    @property
    def proposal_cov(self) -> np.ndarray:
        """Covariance of the first stage's proposals, shape (d, d)."""
        return unpack(self.adaptation, self.position.size).cov


class RandomBlock(NamedTuple):
    """Random numbers of consecutive iterations, along the first axis."""

    normals: np.ndarray  # (iterations, stages, d), for the proposals
    log_uniforms: np.ndarray  # (iterations, stages + 1), to accept a stage or a screened move
    seeds: np.ndarray  # int64 (iterations, stages, noisy), of the estimated likelihoods
    # (iterations, 2), uniform: to choose the kind of proposal, and a component of the mixture or
    # the size of a walk
    choices: np.ndarray
    spreads: np.ndarray  # (iterations,), of a Student-t distribution relative to a normal one


class Draws(NamedTuple):
    """Record of the iterations of a chain, along the first axis."""

    positions: np.ndarray  # (n, d)
    numbers: np.ndarray  # (n, 4), columns LOG_DENSITY, N_EFFECTIVE, ACCEPTANCE, SCALING
    # int64 (n, 8), columns STAGE (whose proposal was accepted, 0 if none was), N_EVALUATIONS,
    # N_FAILED, FAILURE (the last failure code), N_SCREENED, N_SCREEN_FAILED, INDEPENDENT (1 if
    # the proposal was drawn from the mixture), N_ACCEPTED (1 if one was accepted); where only the
    # last of several iterations is kept, of all of them, see `thinned_draws`
    counts: np.ndarray
    seeds: np.ndarray  # int64 (n, noisy)
    covs: np.ndarray  # (n_covs, d, d), of the first stage's proposals, in the first iterations only


class Evaluation(NamedTuple):
    """Result of one evaluation of a log-density."""

    log_density: float  # never NaN or plus infinity; minus infinity after a failure
    failure: int  # 0, or a code of `outcomes.Failure`
    n_effective: float  # smallest number of particles in any filter, infinity without noisy filters


def n_accepted(counts: np.ndarray) -> np.ndarray:
    """In how many iterations a proposal was accepted, of each record if it moves them one by one.

    From counts (n, columns), shape (n, records) or (n, 1).
    """
    if counts.shape[1] == N_COUNTS:
        return counts[:, N_ACCEPTED : N_ACCEPTED + 1]
    return counts[:, N_COUNTS:-N_COMMON_BLOCKS]


def random_block(key: np.ndarray, index: int, n_stages: int, dim: int, n_noisy: int) -> RandomBlock:
    """Draw a chain's random numbers for iterations ``index * BLOCK`` to ``(index + 1) * BLOCK``."""
    rng = generator_of_block(key, index)
    return RandomBlock(
        rng.standard_normal((BLOCK, n_stages, dim)),
        -rng.standard_exponential((BLOCK, n_stages + 1)),
        draw_seeds(rng, (BLOCK, n_stages, n_noisy)),
        rng.random((BLOCK, 2)),
        np.sqrt(DEGREES_OF_FREEDOM / rng.chisquare(DEGREES_OF_FREEDOM, BLOCK)),
    )


def generator_of_block(key: np.ndarray, index: int) -> np.random.Generator:
    """Make the generator of a block; consecutive ones start 2^128 numbers apart."""
    return np.random.Generator(np.random.Philox(key=key, counter=[0, 0, index, 0]))


def draw_key(rng: np.random.Generator) -> np.ndarray:
    """Draw the key of a chain."""
    return rng.integers(0, np.iinfo(np.uint64).max, size=2, dtype=np.uint64, endpoint=True)


def side_generator(key: np.ndarray, number: int = 1) -> np.random.Generator:
    """Make a generator from the chain's key that overlaps none of its blocks, nor another one."""
    return np.random.Generator(np.random.Philox(key=key, counter=[0, 0, 0, number]))


def draw_seeds(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Draw noise seeds, non-negative int64 of the given shape."""
    return rng.integers(0, np.iinfo(np.int64).max, size=shape, dtype=np.int64)
