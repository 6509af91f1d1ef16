"""The state of the adaptation, as views of one vector that can be stored."""

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

# Cells of the numbers of a state, and of the counts of moments.
SCALE, N_BLOCKS, N_STALLS = range(3)
N, MOVED, FIRST = range(3)


class Moments(NamedTuple):
    """Running moments of a piece of a chain, for its covariance.

    Attributes
    ----------
    counts : ndarray, shape (3,)
        Iterations; those that moved; those that moved by the first stage.
    mean : ndarray, shape (d,)
        Mean of the positions.
    scatter : ndarray, shape (d, d)
        Sum of the outer products of the deviations from the mean.
    """

    counts: np.ndarray
    mean: np.ndarray
    scatter: np.ndarray

    @property
    def n(self) -> float:
        """Iterations."""
        return float(self.counts[N])


class AdaptationState(NamedTuple):
    """State of the adaptation.

    Attributes
    ----------
    numbers : ndarray, shape (3,)
        Cell SCALE: factor, at most 1, of the standard deviations of the proposals relative to
        ``2.38 / sqrt(d)`` times those of the draws, reduced at low acceptance. N_BLOCKS: complete
        blocks that were used for a covariance. N_STALLS: blocks in a row with almost no moves.
    cov : ndarray, shape (d, d)
        Proposal covariance of the first stage, all factors included.
    chol : ndarray, shape (d, d)
        Its lower Cholesky factor.
    base : ndarray, shape (d, d)
        The proposal covariance when the block began.
    first_cov : ndarray, shape (d, d)
        The first proposal covariance of the chain.
    block, recent, older : Moments
        The current block; the complete blocks since their number was last a power of two; and
        those between the previous two powers of two.
    """

    numbers: np.ndarray
    cov: np.ndarray
    chol: np.ndarray
    base: np.ndarray
    first_cov: np.ndarray
    block: Moments
    recent: Moments
    older: Moments

    @property
    def scale(self) -> float:
        """The cell SCALE."""
        return float(self.numbers[SCALE])


def start_adaptation(cov: np.ndarray) -> AdaptationState:
    """Make the initial state.

    Parameters
    ----------
    cov : ndarray, shape (d, d)
        Covariance of the first proposals, positive definite.

    Returns
    -------
    AdaptationState
    """
    dim = len(cov)
    state = unpack(np.zeros(packed_size(dim)), dim)
    state.numbers[SCALE] = 1.0
    state.cov[...] = state.base[...] = state.first_cov[...] = cov
    state.chol[...] = np.linalg.cholesky(cov)
    return state


def packed_size(dim: int) -> int:
    """Length of a packed state of dimension d."""
    return 3 + 4 * dim**2 + 3 * (3 + dim + dim**2)


@register_jitable
def unpack(packed: np.ndarray, dim: int) -> AdaptationState:
    """View a vector of length `packed_size` as a state."""
    square, n_moments = dim * dim, 3 + dim + dim * dim
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
        packed[at : at + 3],
        packed[at + 3 : at + 3 + dim],
        _matrix(packed, at + 3 + dim, dim),
    )
