"""What the adaptation of a chain has learnt, as views of one vector that can be stored."""

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

# Cells of the numbers of a state, and of the counts of moments.
SCALE, N_BLOCKS, N_STALLS = range(3)
N, MOVED, FIRST = range(3)


class Moments(NamedTuple):
    """Running moments of a piece of chain: what a covariance needs and no more.

    Attributes
    ----------
    counts : ndarray, shape (3,)
        Iterations; how many moved; and how many of these by the first stage.
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
    """What the adaptation has learnt so far.

    Attributes
    ----------
    numbers : ndarray, shape (3,)
        Cell SCALE: factor, at most 1, by which low acceptance holds the standard deviations of the
        proposals below ``2.38 / sqrt(d)`` times those of the draws. N_BLOCKS: complete blocks that
        taught a covariance. N_STALLS: blocks in a row that moved next to nowhere.
    cov : ndarray, shape (d, d)
        Proposal covariance of the first stage, all factors included.
    chol : ndarray, shape (d, d)
        Its lower Cholesky factor.
    base : ndarray, shape (d, d)
        The proposal covariance when the block began.
    first_cov : ndarray, shape (d, d)
        The proposal covariance that the chain began with.
    block, recent, older : Moments
        The block now running; the complete blocks since their number was last a power of two; and
        those between the power of two before that and it.
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
    """Make the state of a chain that has not moved yet.

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
    """Numbers that a state of dimension d is packed into."""
    return 3 + 4 * dim**2 + 3 * (3 + dim + dim**2)


@register_jitable
def unpack(packed: np.ndarray, dim: int) -> AdaptationState:
    """See a vector of `packed_size` numbers as a state: views, which change with it."""
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
    """Write a state into a vector of `packed_size` numbers: plain data, to be stored."""
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
