"""Adaptation of the proposal covariance of a Gaussian random walk to the chain.

Two schemes:

``"chain"``, the thesis's burn-in (Eqs. 3.27-3.29 and Fig. 4)
    The warm-up is divided into blocks of ``adapt_every`` iterations, each proposing with
    ``(2.38^2 / d) COV`` of earlier iterations, with slightly larger variances. A block that
    accepts almost nothing says nothing about the covariance; the proposals are scaled down instead.
``"continuous"``, adaptive Metropolis (Haario, Saksman and Tamminen 2001)
    The same covariance, updated at every iteration after the first block in which the chain moved.

The state is a few small arrays, views of one vector, that `learn` changes in place. Adaptation must
stop before draws are kept: the caller then no longer calls `learn`.

Differences from the sources
    * Each variance is enlarged by a share of itself, not by a share of their mean: parameters may
      differ by any factor.
    * "Earlier iterations" are the last block for the first two blocks and from then on the latest
      half to three quarters of the warm-up, so that a bad start is forgotten and yet a covariance
      is not estimated from one block alone, which is poor once d is more than a few.
    * A covariance from few accepted moves is averaged with the covariance in use before. So a
      direction not explored yet keeps a proposal of sensible size. That covariance counts as d^2
      moves if its proposals are accepted, as those of a population's are, else as d/5.
    * The scale is reduced in steps: to a fifth after a block that accepts almost nothing, to a half
      if the first stage accepts less than 5 %; it is 1 again once more than 10 % is accepted.
      Between the two lies the acceptance at which pseudo-marginal chains work best.
    * After several stalls in a row the first covariance is restored: with a noisy likelihood a
      chain can stay at an overestimate, however small its proposals, and must be able to leave.
    * Before the first block with moves, a quarter of a block without a single acceptance already
      reduces the scale, because the first covariance is a guess.

References
----------
H. Haario, E. Saksman and J. Tamminen (2001). An adaptive Metropolis algorithm. Bernoulli 7,
223-242.
H. Haario, M. Laine, A. Mira and E. Saksman (2006). DRAM: efficient adaptive MCMC. Statistics and
Computing 16, 339-354.
A. Gelman, G. Roberts and W. Gilks (1996). Efficient Metropolis jumping rules. Bayesian Statistics
5, 599-607.
"""

import numpy as np

from ...compiler.native.jit import linked
from .adaptation_state import (
    FIRST,
    MOVED,
    N_BLOCKS,
    N_PIECE,
    N_STALLS,
    SCALE,
    WALKED,
    AdaptationState,
    Moments,
    N,
)

# Fraction of a block's iterations that must move, by any stage, for a covariance.
LEAST_MOVED = 0.02
# Acceptance rates of the first stage: below the first the scale is halved, above the second it is
# 1 again.
LOW_ACCEPTANCE, FAIR_ACCEPTANCE = 0.05, 0.10
# Factors of the proposals' standard deviation after almost no moves, and after few.
STALLED, SHRINK = 0.2, 0.5
# Stalls in a row that reduce the scale; the next one resets the adaptation.
MOST_STALLS = 6
# Weight of the covariance in use before, in accepted moves: for each of its elements if its
# proposals have a fair acceptance, else for each dimension.
FAIR_MOVES, LOW_MOVES = 1.0, 0.2
# Added to each variance, relative to it.
JITTER = 1e-8

# For functions called only by compiled ones: the wrappers for Python double the compile time.
_internal = linked()


@_internal
def learn(
    adapt_every: int,
    continuous: bool,
    state: AdaptationState,
    position: np.ndarray,
    stage: int,
    is_free: bool,
) -> None:
    """Adapt to one iteration of warm-up, in place, after which the chain is at a position (d,).

    A block has ``adapt_every`` iterations; the scheme is ``"continuous"`` or ``"chain"``. The
    proposal of this stage was accepted, none if it is 0. If the proposal was not a random walk of
    the adapted size (``is_free``), its draw counts for the covariance, but not for the acceptance
    rate.
    """
    block = state.block.counts
    _include(state.block, 1.0, position)
    block[MOVED] += 1.0 if stage > 0 else 0.0
    block[WALKED] += 0.0 if is_free else 1.0
    block[FIRST] += 1.0 if stage == 1 and not is_free else 0.0
    if _has_stalled(adapt_every, state.numbers, block):
        _forget_block(state)
    elif block[N] >= adapt_every:
        _close_block(state)
        _learn_covariance(state)
    elif continuous and state.numbers[N_BLOCKS] > 0.0:
        _learn_covariance(state)


# The functions below use loops, which compile several times faster than array expressions.


@_internal
def _copy_of_moments(moments: Moments) -> Moments:
    return Moments(moments.counts.copy(), moments.mean.copy(), moments.scatter.copy())


@_internal
def _scale_into(target: np.ndarray, matrix: np.ndarray, factor: float) -> None:
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            target[i, j] = matrix[i, j] * factor


@_internal
def _include(moments: Moments, n: float, mean: np.ndarray) -> None:
    """Add n iterations at one position (Chan, Golub and LeVeque)."""
    before, old = moments.counts[N], moments.mean
    total = max(1.0, before + n)
    for i in range(mean.size):
        apart = mean[i] - old[i]
        for j in range(mean.size):
            moments.scatter[i, j] += apart * (mean[j] - old[j]) * before * n / total
    for i in range(mean.size):
        old[i] += (mean[i] - old[i]) * n / total
    moments.counts[N] = before + n


@_internal
def _merge(moments: Moments, other: Moments) -> None:
    """Add the moments of another piece of the chain."""
    dim = other.mean.size
    for i in range(dim):
        for j in range(dim):
            moments.scatter[i, j] += other.scatter[i, j]
    _include(moments, other.counts[N], other.mean)
    moments.counts[MOVED] += other.counts[MOVED]
    moments.counts[FIRST] += other.counts[FIRST]
    moments.counts[WALKED] += other.counts[WALKED]


@_internal
def _clear(moments: Moments) -> None:
    for i in range(N_PIECE):
        moments.counts[i] = 0.0
    for i in range(moments.mean.size):
        moments.mean[i] = 0.0
        for j in range(moments.mean.size):
            moments.scatter[i, j] = 0.0


@_internal
def _has_stalled(adapt_every: int, numbers: np.ndarray, block: np.ndarray) -> bool:
    if numbers[N_BLOCKS] == 0.0 and block[MOVED] == 0.0 and 4 * block[N] >= adapt_every:
        return True
    return block[N] >= adapt_every and block[MOVED] < LEAST_MOVED * block[N]


@_internal
def _forget_block(state: AdaptationState) -> None:
    """Discard a stalled block and reduce the scale; after too many stalls reset everything."""
    numbers = state.numbers
    _clear(state.block)
    if numbers[N_STALLS] < MOST_STALLS:
        numbers[N_STALLS] += 1.0
        _scale_into(state.cov, state.cov, STALLED**2)
        _scale_into(state.chol, state.chol, STALLED)
    else:
        numbers[SCALE], numbers[N_BLOCKS], numbers[N_STALLS] = 1.0, 0.0, 0.0
        _scale_into(state.cov, state.first_cov, 1.0)
        _scale_into(state.chol, _cholesky(state.first_cov), 1.0)
        _clear(state.recent)
        _clear(state.older)
    _scale_into(state.base, state.cov, 1.0)


@_internal
def _close_block(state: AdaptationState) -> None:
    """Merge a complete block, and set the scale by its acceptance rate."""
    numbers, block = state.numbers, state.block.counts
    if block[FIRST] < LOW_ACCEPTANCE * block[WALKED]:
        numbers[SCALE] *= SHRINK
    elif block[FIRST] > FAIR_ACCEPTANCE * block[WALKED]:
        numbers[SCALE] = 1.0
    numbers[N_BLOCKS] += 1.0
    numbers[N_STALLS] = 0.0
    _scale_into(state.base, state.cov, 1.0)
    _merge(state.recent, state.block)
    _clear(state.block)
    n_blocks = int(numbers[N_BLOCKS])
    if n_blocks & (n_blocks - 1) == 0:
        _replace(state.older, state.recent)
        _clear(state.recent)


@_internal
def _replace(moments: Moments, other: Moments) -> None:
    for i in range(N_PIECE):
        moments.counts[i] = other.counts[i]
    for i in range(other.mean.size):
        moments.mean[i] = other.mean[i]
    _scale_into(moments.scatter, other.scatter, 1.0)


@_internal
def _learn_covariance(state: AdaptationState) -> None:
    """Proposal covariance, thesis Eqs. 3.28-3.29, averaged with the one in use before."""
    moments = _copy_of_moments(state.older)
    _merge(moments, state.recent)
    if state.block.counts[N] > 0.0:
        _merge(moments, state.block)
    n, moved, base = moments.counts[N], moments.counts[MOVED], state.base
    dim = base.shape[0]
    is_fair = moments.counts[FIRST] > FAIR_ACCEPTANCE * moments.counts[WALKED]
    weight = moved / (moved + (FAIR_MOVES * dim**2 if is_fair else LOW_MOVES * dim))
    factor = weight * (2.38 * state.numbers[SCALE]) ** 2 / (dim * n)
    cov = np.empty((dim, dim))
    for i in range(dim):
        for j in range(i + 1):
            cov[i, j] = factor * moments.scatter[i, j] + (1.0 - weight) * base[i, j]
            cov[j, i] = cov[i, j]
        cov[i, i] *= 1.0 + JITTER
    chol = _cholesky(cov)
    if 0.0 < chol[dim - 1, dim - 1] < np.inf:  # else the draws have overflowed or are NaN
        _scale_into(state.cov, cov, 1.0)
        _scale_into(state.chol, chol, 1.0)


@_internal
def _cholesky(cov: np.ndarray) -> np.ndarray:
    """Lower Cholesky factor, NaN from the first column without one."""
    dim = cov.shape[0]
    chol = np.zeros((dim, dim))
    for j in range(dim):
        for i in range(j, dim):
            rest = cov[i, j]
            for k in range(j):
                rest -= chol[i, k] * chol[j, k]
            chol[i, j] = np.sqrt(rest) if i == j else rest / chol[j, j]
    return chol
