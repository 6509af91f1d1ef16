"""Adaptation of a Gaussian random walk: what the proposal covariance learns from the chain.

Two schemes, chosen once and then called through the same signature
``adapt(settings, state, position, stage) -> state``:

``"chain"``, the thesis's burn-in (Eqs. 3.27-3.29 and Fig. 4)
    The warm-up is a succession of blocks of ``adapt_every`` iterations, each proposing with
    ``(2.38^2 / d) COV`` of what came before it, plus a small multiple of the identity. A block that
    accepts next to nothing tells nothing about the covariance: the scale shrinks instead.
``"continuous"``, adaptive Metropolis (Haario, Saksman and Tamminen 2001)
    The same covariance renewed at every iteration, once a first block has shown that the chain
    moves.

The functions are compiled and pure (settings and state are named tuples, the state is returned), so
that PyMC's step method and whole compiled chains call the same code. Adaptation must stop before
draws are kept: whoever drives it simply stops calling.

Differences from the sources
    * "What came before" is the last block for the first two blocks and from then on the latest half
      to three quarters of the warm-up, so that a bad start is forgotten and yet a covariance does
      not rest on one block alone, which is poor once d is more than a few.
    * A covariance from few accepted moves is blended with the covariance in use before, which
      counts as d/5 moves. So a direction not explored yet keeps a proposal of sensible size.
    * The scale shrinks in degrees: to a fifth where a block moves next to nowhere, to a half where
      the first stage accepts less than 5 %; it is 1 again once more than 10 % is accepted. Between
      the two lies the acceptance at which pseudo-marginal chains work best.
    * After several stalls in a row the first covariance is back: with a noisy likelihood a chain
      can sit on a lucky estimate, which no shrinking mends, and must still be able to leave.
    * Before the first block that moves, a quarter of a block without a single acceptance already
      shrinks the scale: a starting covariance is a guess.

References
----------
H. Haario, E. Saksman and J. Tamminen (2001). An adaptive Metropolis algorithm. Bernoulli 7,
223-242.
H. Haario, M. Laine, A. Mira and E. Saksman (2006). DRAM: efficient adaptive MCMC. Statistics and
Computing 16, 339-354.
A. Gelman, G. Roberts and W. Gilks (1996). Efficient Metropolis jumping rules. Bayesian Statistics
5, 599-607.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

# Share of a block's iterations that must move at all, by any stage, to teach a covariance.
LEAST_MOVED = 0.02
# Below the first, the first stage's share of acceptances halves the scale; above the second, the
# scale is 1 again.
LOW_ACCEPTANCE, FAIR_ACCEPTANCE = 0.05, 0.10
# Factors of the proposals' standard deviation when next to nothing moved, and when little did.
STALLED, SHRINK = 0.2, 0.5
# Stalls in a row that shrink the proposals; the next one starts anew.
MOST_STALLS = 6
# Weight of the covariance in use before, in accepted moves for each dimension.
PRIOR_MOVES = 0.2
# The multiple of the identity, relative to the mean variance.
JITTER = 1e-8


class AdaptationSettings(NamedTuple):
    """What does not change while a chain runs.

    Attributes
    ----------
    adapt_every : int
        Iterations in a block.
    """

    adapt_every: int


class Moments(NamedTuple):
    """Running moments of a piece of chain: what a covariance needs and no more.

    Attributes
    ----------
    n, moved, first : float
        Iterations; how many moved; and how many of these by the first stage.
    mean : ndarray, shape (d,)
        Mean of the positions.
    scatter : ndarray, shape (d, d)
        Sum of the outer products of the deviations from the mean.
    """

    n: float
    moved: float
    first: float
    mean: np.ndarray
    scatter: np.ndarray


class AdaptationState(NamedTuple):
    """What the adaptation has learnt so far.

    Attributes
    ----------
    cov : ndarray, shape (d, d)
        Proposal covariance of the first stage, all factors included.
    chol : ndarray, shape (d, d)
        Its lower Cholesky factor.
    base : ndarray, shape (d, d)
        The proposal covariance when the block began.
    scale : float
        Factor, at most 1, by which low acceptance holds the standard deviations of the proposals
        below ``2.38 / sqrt(d)`` times those of the draws.
    n_blocks : int
        Complete blocks that taught a covariance.
    n_stalls : int
        Blocks in a row that moved next to nowhere.
    first_cov : ndarray, shape (d, d)
        The proposal covariance that the chain began with.
    block, recent, older : Moments
        The block now running; the complete blocks since their number was last a power of two; and
        those between the power of two before that and it.
    """

    cov: np.ndarray
    chol: np.ndarray
    base: np.ndarray
    scale: float
    n_blocks: int
    n_stalls: int
    first_cov: np.ndarray
    block: Moments
    recent: Moments
    older: Moments


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
    cov = np.ascontiguousarray(cov, dtype=np.float64)
    none = _no_moments(cov.shape[0])
    return AdaptationState(cov, np.linalg.cholesky(cov), cov, 1.0, 0, 0, cov, none, none, none)


def packed_size(dim: int) -> int:
    """Numbers that a state of dimension d is packed into."""
    return 3 + 4 * dim**2 + 3 * (3 + dim + dim**2)


@njit(cache=True, error_model="numpy")
def pack(state: AdaptationState, packed: np.ndarray) -> None:
    """Write a state into a vector of `packed_size` numbers: plain data, to be stored."""
    packed[0], packed[1], packed[2] = state.scale, state.n_blocks, state.n_stalls
    at = 3
    for matrix in (state.cov, state.chol, state.base, state.first_cov):
        at = _put(matrix, packed, at)
    for moments in (state.block, state.recent, state.older):
        packed[at], packed[at + 1], packed[at + 2] = moments.n, moments.moved, moments.first
        at = _put(moments.mean, packed, at + 3)
        at = _put(moments.scatter, packed, at)


@njit(cache=True, error_model="numpy")
def unpack(packed: np.ndarray, dim: int) -> AdaptationState:
    """Read a state from its vector."""
    square, n_moments = dim * dim, 3 + dim + dim * dim
    at = 3 + 4 * square
    return AdaptationState(
        _matrix(packed, 3, dim),
        _matrix(packed, 3 + square, dim),
        _matrix(packed, 3 + 2 * square, dim),
        packed[0],
        int(packed[1]),
        int(packed[2]),
        _matrix(packed, 3 + 3 * square, dim),
        _moments(packed, at, dim),
        _moments(packed, at + n_moments, dim),
        _moments(packed, at + 2 * n_moments, dim),
    )


@njit(cache=True, error_model="numpy")
def _put(values: np.ndarray, packed: np.ndarray, at: int) -> int:
    for value in values.flat:
        packed[at] = value
        at += 1
    return at


@njit(cache=True, error_model="numpy")
def _matrix(packed: np.ndarray, at: int, dim: int) -> np.ndarray:
    matrix = np.empty((dim, dim))
    for i in range(dim):
        for j in range(dim):
            matrix[i, j] = packed[at + i * dim + j]
    return matrix


@njit(cache=True, error_model="numpy")
def _moments(packed: np.ndarray, at: int, dim: int) -> Moments:
    mean = packed[at + 3 : at + 3 + dim].copy()
    return Moments(
        packed[at], packed[at + 1], packed[at + 2], mean, _matrix(packed, at + 3 + dim, dim)
    )


@njit(cache=True, error_model="numpy")
def adapt_by_blocks(
    settings: AdaptationSettings, state: AdaptationState, position: np.ndarray, stage: int
) -> AdaptationState:
    """Take in one iteration of warm-up under the scheme ``"chain"``.

    Parameters
    ----------
    settings : AdaptationSettings
    state : AdaptationState
    position : ndarray, shape (d,)
        Where the chain stands after the iteration.
    stage : int
        The stage whose proposal was accepted, 0 if none was.

    Returns
    -------
    AdaptationState
    """
    block = _include(state.block, position, stage)
    if _has_stalled(settings, state.n_blocks, block):
        return _stalled(state)
    if block.n < settings.adapt_every:
        return _with_block(state, block)
    state = _close_block(state, block)
    return _learn(state, _merge(state.older, state.recent))


@njit(cache=True, error_model="numpy")
def adapt_continuously(
    settings: AdaptationSettings, state: AdaptationState, position: np.ndarray, stage: int
) -> AdaptationState:
    """Take in one iteration of warm-up under the scheme ``"continuous"``.

    Parameters and the value returned are those of ``adapt_by_blocks``.
    """
    block = _include(state.block, position, stage)
    if _has_stalled(settings, state.n_blocks, block):
        return _stalled(state)
    if block.n < settings.adapt_every:
        state = _with_block(state, block)
        if state.n_blocks == 0:
            return state
    else:
        state = _close_block(state, block)
    return _learn(state, _merge(_merge(state.older, state.recent), state.block))


# The helpers below are written as loops, which compile several times faster than array expressions.


@njit(cache=True, error_model="numpy")
def _no_moments(dim: int) -> Moments:
    return Moments(0.0, 0.0, 0.0, np.zeros(dim), np.zeros((dim, dim)))


@njit(cache=True, error_model="numpy")
def _include(moments: Moments, position: np.ndarray, stage: int) -> Moments:
    moved = 1.0 if stage > 0 else 0.0
    first = 1.0 if stage == 1 else 0.0
    return _merge(moments, Moments(1.0, moved, first, position, np.zeros_like(moments.scatter)))


@njit(cache=True, error_model="numpy")
def _merge(a: Moments, b: Moments) -> Moments:
    """Moments of two pieces together (Chan, Golub and LeVeque)."""
    dim = a.mean.size
    n = max(1.0, a.n + b.n)
    mean, scatter = np.empty(dim), np.empty((dim, dim))
    for i in range(dim):
        apart = b.mean[i] - a.mean[i]
        mean[i] = a.mean[i] + apart * b.n / n
        for j in range(dim):
            between = apart * (b.mean[j] - a.mean[j]) * a.n * b.n / n
            scatter[i, j] = a.scatter[i, j] + b.scatter[i, j] + between
    return Moments(a.n + b.n, a.moved + b.moved, a.first + b.first, mean, scatter)


@njit(cache=True, error_model="numpy")
def _has_stalled(settings: AdaptationSettings, n_blocks: int, block: Moments) -> bool:
    if n_blocks == 0 and block.moved == 0.0 and 4 * block.n >= settings.adapt_every:
        return True
    full = block.n >= settings.adapt_every
    return full and block.moved < LEAST_MOVED * block.n


@njit(cache=True, error_model="numpy")
def _stalled(state: AdaptationState) -> AdaptationState:
    """Forget the stalled block, propose closer by; after too many stalls forget everything."""
    none = _no_moments(state.cov.shape[0])
    first = state.first_cov
    if state.n_stalls == MOST_STALLS:
        return AdaptationState(first, _cholesky(first), first, 1.0, 0, 0, first, none, none, none)
    cov = _scaled(state.cov, STALLED**2)
    return AdaptationState(
        cov,
        _scaled(state.chol, STALLED),
        cov,
        state.scale,
        state.n_blocks,
        state.n_stalls + 1,
        first,
        none,
        state.recent,
        state.older,
    )


@njit(cache=True, error_model="numpy")
def _with_block(state: AdaptationState, block: Moments) -> AdaptationState:
    cov, chol, base, scale, n_blocks, n_stalls, first, _, recent, older = state
    return AdaptationState(cov, chol, base, scale, n_blocks, n_stalls, first, block, recent, older)


@njit(cache=True, error_model="numpy")
def _close_block(state: AdaptationState, block: Moments) -> AdaptationState:
    """File a complete block and let its acceptance move the scale."""
    cov, chol, _, scale, n_blocks, _, first, _, recent, older = state
    if block.first < LOW_ACCEPTANCE * block.n:
        scale *= SHRINK
    elif block.first > FAIR_ACCEPTANCE * block.n:
        scale = 1.0
    n_blocks += 1
    none = _no_moments(cov.shape[0])
    recent = _merge(recent, block)
    if n_blocks & (n_blocks - 1) == 0:
        older, recent = recent, none
    return AdaptationState(cov, chol, cov, scale, n_blocks, 0, first, none, recent, older)


@njit(cache=True, error_model="numpy")
def _learn(state: AdaptationState, moments: Moments) -> AdaptationState:
    """Proposal covariance, thesis Eqs. 3.28-3.29, blended with the one in use before."""
    _, _, base, scale, n_blocks, n_stalls, first, block, recent, older = state
    dim = base.shape[0]
    weight = moments.moved / (moments.moved + PRIOR_MOVES * dim)
    learnt = weight * (2.38 * scale) ** 2 / (dim * moments.n)
    cov, mean_variance = np.empty((dim, dim)), 0.0
    for i in range(dim):
        for j in range(i + 1):
            cov[i, j] = learnt * moments.scatter[i, j] + (1.0 - weight) * base[i, j]
            cov[j, i] = cov[i, j]
        mean_variance += cov[i, i] / dim
    for i in range(dim):
        cov[i, i] += JITTER * mean_variance
    chol = _cholesky(cov)
    if not 0.0 < chol[dim - 1, dim - 1] < np.inf:  # the draws have overflowed (or NaN)
        return state
    return AdaptationState(cov, chol, base, scale, n_blocks, n_stalls, first, block, recent, older)


@njit(cache=True, error_model="numpy")
def _scaled(matrix: np.ndarray, factor: float) -> np.ndarray:
    scaled = np.empty_like(matrix)
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            scaled[i, j] = matrix[i, j] * factor
    return scaled


@njit(cache=True, error_model="numpy")
def _cholesky(cov: np.ndarray) -> np.ndarray:
    """Lower Cholesky factor, NaN on and after the first column that has none."""
    dim = cov.shape[0]
    chol = np.zeros((dim, dim))
    for j in range(dim):
        for i in range(j, dim):
            rest = cov[i, j]
            for k in range(j):
                rest -= chol[i, k] * chol[j, k]
            chol[i, j] = np.sqrt(rest) if i == j else rest / chol[j, j]
    return chol
