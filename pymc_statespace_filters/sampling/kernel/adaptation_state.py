"""The state of the adaptation, as views of one vector that can be stored."""

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

# Cells of the numbers of a state, and of the counts of moments.
SCALE, N_BLOCKS, N_STALLS = range(3)
N, MOVED, FIRST, WALKED = range(4)
N_PIECE = 4


class Moments(NamedTuple):
    """Running moments of a piece of a chain, for its covariance."""

    # (4,): iterations; those that moved; those that moved by the first stage of the random walk;
    # those that made a random walk
    counts: np.ndarray
    mean: np.ndarray  # (d,), of the positions
    scatter: np.ndarray  # (d, d), sum of outer products of the deviations from the mean

    @property
    def n(self) -> float:
        """Iterations."""
        return float(self.counts[N])


class AdaptationState(NamedTuple):
    """State of the adaptation.

    Its numbers are SCALE, a factor of at most 1 for the standard deviations of the proposals
    relative to ``2.38 / sqrt(d)`` times those of the draws, reduced at low acceptance; N_BLOCKS,
    the complete blocks that were used for a covariance; and N_STALLS, the blocks in a row with
    almost no moves.
    """

    numbers: np.ndarray  # (3,)
    cov: np.ndarray  # (d, d), of the first stage's proposals, all factors included
    chol: np.ndarray  # (d, d), its lower Cholesky factor
    base: np.ndarray  # (d, d), the proposal covariance when the block began
    first_cov: np.ndarray  # (d, d), the first proposal covariance of the chain
    block: Moments  # the current block
    recent: Moments  # the complete blocks since their number was last a power of two
    older: Moments  # those between the previous two powers of two

    @property
    def scale(self) -> float:
        """The cell SCALE."""
        return float(self.numbers[SCALE])


def start_adaptation(cov: np.ndarray) -> AdaptationState:
    """Make the initial state, with the positive definite covariance of the first proposals."""
    dim = len(cov)
    state = unpack(np.zeros(packed_size(dim)), dim)
    state.numbers[SCALE] = 1.0
    state.cov[...] = state.base[...] = state.first_cov[...] = cov
    state.chol[...] = np.linalg.cholesky(cov)
    return state


@register_jitable
def packed_size(dim: int) -> int:
    """Length of a packed state of dimension d."""
    return 3 + 4 * dim**2 + 3 * (N_PIECE + dim + dim**2)


@register_jitable
def unpack(packed: np.ndarray, dim: int) -> AdaptationState:
    """View a vector of length `packed_size` as a state."""
    square, n_moments = dim * dim, N_PIECE + dim + dim * dim
    at = 3 + 4 * square
    return AdaptationState(
        packed[:3],
        _matrix(packed, 3, dim),
        _matrix(packed, 3 + square, dim),
        _matrix(packed, 3 + 2 * square, dim),
        _matrix(packed, 3 + 3 * square, dim),
        _moments(packed, at, dim),
        _moments(packed, at + n_moments, dim),
        _moments(packed, at + 2 * n_moments, dim),
    )


def pack(state: AdaptationState, packed: np.ndarray) -> None:
    """Write a state into a vector of length `packed_size`."""
    for mine, given in zip(unpack(packed, len(state.cov)), state, strict=True):
        if isinstance(given, Moments):
            for my_part, part in zip(mine, given, strict=True):
                my_part[...] = part
        else:
            mine[...] = given


@register_jitable
def _matrix(packed: np.ndarray, at: int, dim: int) -> np.ndarray:
    return packed[at : at + dim * dim].reshape(dim, dim)


@register_jitable
def _moments(packed: np.ndarray, at: int, dim: int) -> Moments:
    return Moments(
        packed[at : at + N_PIECE],
        packed[at + N_PIECE : at + N_PIECE + dim],
        _matrix(packed, at + N_PIECE + dim, dim),
    )
