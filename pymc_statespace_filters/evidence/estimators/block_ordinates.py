r"""Chib and Jeliazkov's posterior ordinate, block by block (their section 2.2).

The parameters are divided into blocks, and the ordinate of the posterior at x* is a product of
conditional ordinates,

.. math::

    p(x^*|D) = \prod_b p(x_b^* | x_{<b}^*, D), \qquad p(x_b^* | x_{<b}^*, D) =
        \frac{E_b[\alpha(x, x')\, q(x_b, x_b^*)]}{E_{b+1}[\alpha(x', x)]}.

E_b is the mean over draws x of the conditional posterior of the blocks from b on, with the earlier
blocks fixed at x*; x' is x with block b replaced by x_b*. In E_{b+1}, x' is such a draw of the
blocks after b, and x is x' with block b drawn from q(x_b*, .). The draws of run 1 are those of the
posterior; the later, reduced runs are made here. The last one has no free block and is the point
x*.

Blocks are of whitened coordinates y, x = x* + L y, where L L^T is the covariance of the draws. A
Gaussian posterior has independent blocks of unit variance there, so that q = N(0, I) needs no
scale. The ordinate in x is that in y divided by det L.

Each run serves two means, the denominator of one block and the numerator of the next: the error is
that of the difference of the two terms, draw by draw.

With a noisy likelihood a draw keeps the estimate by which its chain accepted it, and a proposed
point (x' in the numerators, x in the denominators) gets a fresh one. On (x, noise) the proposal is
q times the distribution of the noise, and both sides of detailed balance, integrated over all
variables, are

.. math::

    \int\!\!\int \min(e^{f(x, u)}, e^{f(x', u')})\, q(x_b, x_b^*)\, g(u)\, g(u')\, dx\, du\, du',

p(D | x_<b*) times the numerator and p(D | x_<=b*) times the denominator, so that the ratios are
exact for the expected likelihood. In the last block e^{f(x')} is replaced by any one constant, as
with a single block.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from ...errors import DataMismatchError
from ...statistics.importance import log_mean, mcse_of_chains, mcse_of_walkers
from ..posterior import Posterior
from .random_walk_proposal import Proposal
from .whitening import Whitening

N_WALKERS = 64
N_WARMUP = 30
START_SCALE = 0.7  # below one, so that no draw in the tails starts many walkers

Array = NDArray[np.float64]
Target = Callable[[Array], Array]  # log-densities (m,) of whitened points (m, k)


@dataclass(frozen=True)
class Run:
    """Draws in whitened coordinates, y (chain, draw, k), with their stored estimates."""

    y: Array
    log_density: Array  # (chain, draw)
    n_moves: float = math.inf  # accepted by a walker on average

    def with_block(self, values: Array | float, block: slice) -> Array:
        """The draws with `values` in one block, flat (m, k)."""
        moved = self.y.copy()
        moved[..., block] = values
        return moved.reshape(-1, moved.shape[-1])


@dataclass(frozen=True)
class BlockEstimate:
    """A log-evidence with its error and diagnostics."""

    log_evidence: float
    se: float
    n_effective: float  # of the worst run
    n_moves: float  # accepted by a walker of the worst reduced run, its warm-up included


def estimate_in_blocks(
    proposal: Proposal,
    posterior: Posterior,
    *,
    n_blocks: int,
    n_proposals: int,
    rng: np.random.Generator,
) -> BlockEstimate:
    """Estimate the log-evidence with the point x* and the covariance of `proposal`.

    This is fitted to other draws than those of `posterior`. The blocks, at most k, are of
    neighbouring coordinates and nearly equal size; ``n_proposals`` are the draws of every run, and
    the fresh evaluations in every mean over one.
    """
    point, chol = proposal.point, proposal.chol
    k = len(point)

    def target(y: Array) -> Array:
        return posterior.evaluate(point + y @ chol.T, rng)

    thinned = posterior.thinned(n_proposals)
    run = _run_of(thinned, proposal)
    center = run.y.mean(axis=(0, 1))
    log_ordinate = -float(np.log(np.diag(chol)).sum())
    denominator_terms: Array | float = 0.0
    errors, n_moves = [], []
    ends = np.linspace(0, k, n_blocks + 1).round().astype(int)
    for start, stop in pairwise(ends):
        block, is_last = slice(start, stop), stop == k
        at_center = run.with_block(0.0, block)
        fresh = np.full(len(at_center), proposal.log_density) if is_last else target(at_center)
        log_to_center = _log_alpha_q_to_center(run, fresh, block)
        numerator, numerator_terms = _normalised(log_to_center, "draws moved to the central point")
        # Both terms come from one run, so that the error is that of their difference.
        terms = numerator_terms - denominator_terms
        errors.append(mcse_of_chains(terms) if start == 0 else mcse_of_walkers(terms))

        if is_last:
            constant = np.full((1, n_proposals), proposal.log_density)
            run = Run(np.zeros((1, n_proposals, k)), constant)
        else:
            chosen = _choose_walkers(run, fresh, block, rng)
            free = slice(stop, k)
            run = _walk(target, at_center[chosen], fresh[chosen], center, free, n_proposals, rng)
            n_moves.append(run.n_moves)
        log_from_center = _log_alpha_from_center(target, run, block, rng)
        denominator, denominator_terms = _normalised(log_from_center, "proposals around the draws")
        log_ordinate += numerator - denominator

    errors.append(float(np.std(denominator_terms)) / n_proposals**0.5)
    return BlockEstimate(
        log_evidence=proposal.log_density - log_ordinate,
        se=math.hypot(*errors),
        n_effective=max(errors) ** -2,
        n_moves=min(n_moves, default=math.inf),
    )


def _log_alpha_q_to_center(run: Run, fresh: Array, block: slice) -> Array:
    """Numerator terms: log of alpha(x, x') q(x_b, x_b*), with `fresh` the log-densities of x'."""
    gain = fresh.reshape(run.log_density.shape) - run.log_density
    return np.minimum(0.0, gain) + _log_normal(run.y[..., block])


def _log_alpha_from_center(
    target: Target, run: Run, block: slice, rng: np.random.Generator
) -> Array:
    """Denominator terms: log of alpha(x', x), with the block of x drawn from q(x_b*, .)."""
    steps = rng.standard_normal(run.y[..., block].shape)
    proposed = target(run.with_block(steps, block)).reshape(run.log_density.shape)
    return np.minimum(0.0, proposed - run.log_density)


def _choose_walkers(
    run: Run, fresh: Array, block: slice, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Resample draws, moved to x_b*, as starting points of the walkers of the next run."""
    gain = fresh.reshape(run.log_density.shape) - run.log_density
    log_weights = (gain + _log_normal(run.y[..., block] / START_SCALE)).ravel()
    return rng.choice(len(fresh), size=N_WALKERS, p=softmax(log_weights))


def _run_of(posterior: Posterior, proposal: Proposal) -> Run:
    """Draws of the posterior in whitened coordinates."""
    flat = posterior.draws.reshape(-1, len(proposal.point))
    y = Whitening(proposal.point, proposal.chol).whitened(flat)
    return Run(y.reshape(posterior.draws.shape), posterior.log_density)


def _walk(
    target: Target,
    y: Array,
    log_density: Array,
    centre: Array,
    free: slice,
    n_draws: int,
    rng: np.random.Generator,
) -> Run:
    """Sample the free coordinates given the others, by independent Metropolis walkers.

    The walkers start at y (walker, k), resampled from the previous run with the stored estimates. A
    proposal rotates a walker by a random angle towards a new draw of N(centre, I), which leaves
    N(centre, I) invariant: large angles suit a nearly Gaussian posterior, small ones any other.
    """
    n_kept = -(-n_draws // len(y))
    kept_y, kept_log_density, n_moves = [], [], 0.0
    for step in range(N_WARMUP + n_kept):
        angle = rng.uniform(0, np.pi / 2, size=(len(y), 1))
        current = y[:, free] - centre[free]
        turned = np.cos(angle) * current + np.sin(angle) * rng.standard_normal(current.shape)
        proposed = y.copy()
        proposed[:, free] = centre[free] + turned
        proposed_log_density = target(proposed)
        log_ratio = proposed_log_density - log_density
        log_ratio += 0.5 * (turned**2 - current**2).sum(axis=1)
        accept = -rng.exponential(size=len(y)) < log_ratio
        y = np.where(accept[:, np.newaxis], proposed, y)
        log_density = np.where(accept, proposed_log_density, log_density)
        n_moves += accept.mean()
        if step >= N_WARMUP:
            kept_y.append(y)
            kept_log_density.append(log_density)
    return Run(np.stack(kept_y, axis=1), np.stack(kept_log_density, axis=1), float(n_moves))


def _log_normal(y: Array) -> Array:
    """Log-density of N(0, I) at y (..., k)."""
    return -0.5 * (y**2).sum(axis=-1) - 0.5 * y.shape[-1] * np.log(2 * np.pi)


def _normalised(log_terms: Array, what: str) -> tuple[float, Array]:
    """Log of the mean of positive terms, and the terms divided by their mean."""
    value = log_mean(log_terms)
    if np.isneginf(value):
        raise DataMismatchError(
            f"all {log_terms.size} {what} have zero density: idata belongs to another model or to "
            "other data, or needs n_blocks=1"
        )
    return value, np.exp(log_terms - value)
