r"""Bridge sampling to a normal distribution (Meng and Wong 1996).

With f = log prior + log likelihood, a normalised density q and any function h,

.. math::

    p(D) = \frac{E_{x \sim q}[e^{f(x)} h(x)]}{E_{x \sim p(x|D)}[q(x) h(x)]},

and the error is smallest for h = 1 / (n_1 e^f / p(D) + n_2 q), if n_1 draws of the posterior and
n_2 of q are independent (their Eq. 3.3). In logs, with l = f - ln q, the fixed point p(D) solves

.. math::

    \ln E_q[\sigma(u)] - \ln E_{p(x|D)}[\sigma(-u)] = \ln (n_1 / n_2),
    \qquad u = l - \ln p(D) + \ln (n_1 / n_2), \quad \sigma(u) = 1 / (1 + e^{-u}).

The effective sample size of autocorrelated draws replaces n_1. The variance is that of the two
means under this h (Fruehwirth-Schnatter 2004): any h gives the same p(D), so that the uncertainty
of h does not matter to first order. The terms are bounded, so that the variance is finite whatever
the tails of q.

Differences from the sources. The fixed point is bracketed instead of iterated: the equation is
monotone in ln p(D), and the iteration is slow if the two distributions hardly overlap. The
estimator is cross-fitted: q fitted to one half of every chain is used with the draws of the other
half, and the two estimates are averaged, because q overlaps too well with the draws to which it was
fitted. The two estimates are not independent: if the halves differ, each sees the other's q
displaced by the same amount. This part of their errors is measured by the change of the terms under
a q fitted to all draws, and counted as common to both.

With a noisy likelihood, f of a draw is the estimate stored by the chain, and f of a new point is a
fresh estimate. The identity then holds on the space of x and noise, with q times the distribution
of the noise in place of q.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, log_expit
from scipy.stats import Covariance, multivariate_normal

from ...statistics.importance import (
    MIN_EFFECTIVE,
    LogMean,
    bridge_constant,
    disagreement,
    log_mean_of_draws,
    log_mean_of_independent,
    mcse_of_chains,
)
from ..posterior import Posterior, check_overlap
from .protocol import Estimate
from .stopping import check_target, is_small, shortfall, totals
from .whitening import NormalProposals, Whitening, moments, normal_proposals

MAX_ERROR = MIN_EFFECTIVE**-0.5  # the error of `MIN_EFFECTIVE` terms of relative variance one
MAX_GAP = 4.0

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Bridge:
    """Bridge sampling to a normal distribution fitted to the draws (Meng and Wong 1996).

    Parameters
    ----------
    target_se : float, optional
        Standard error to be reached. The number of proposals is doubled from 1000 to at most 16 000
        until it is, or until the error of the draws dominates. By default it is the number of
        draws, within 1000 to 10 000.

    Examples
    --------
    >>> from pymc_statespace_filters.evidence.estimators.bridge import Bridge
    >>> Bridge(target_se=0.02)
    Bridge(target_se=0.02)
    """

    name: ClassVar[str] = "bridge"
    target_se: float | None = None

    def __post_init__(self) -> None:
        check_target(self.target_se)

    def n_evaluations(self, posterior: Posterior) -> int:
        """One per proposal; with a target, the fewest."""
        return next(totals(posterior, self.target_se))

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence from the draws and further log-density evaluations."""
        pooled = moments(posterior.draws)
        proposals = normal_proposals(posterior, rng)
        halves = tuple(reversed(posterior.halves()))  # those to be averaged
        for n_proposals in totals(posterior, self.target_se):
            folds = [
                _bridge(averaged, q, n_proposals // 2, pooled)
                for q, averaged in zip(proposals, halves, strict=True)
            ]
            se_draws, se_proposals = _errors(folds)
            if is_small(self.target_se, se_draws, se_proposals):
                break
        return self._summary(folds, posterior, 2 * (n_proposals // 2))

    def _summary(
        self, folds: Sequence["_Fold"], posterior: Posterior, n_proposals: int
    ) -> Estimate:
        """The average of both folds."""
        n_draws = posterior.log_density.size
        se_draws, se_proposals = _errors(folds)
        se = math.hypot(se_draws, se_proposals)
        gap = abs(folds[0].log_evidence - folds[1].log_evidence) / (2 * se)
        n_effective = sum(fold.n_effective for fold in folds)
        return Estimate(
            log_evidence=float(np.mean([fold.log_evidence for fold in folds])),
            se=se,
            settings={
                "n_draws": n_draws,
                "n_proposals": n_proposals,
                "n_effective_draws": n_effective,
                "se_draws": se_draws,
                "se_proposals": se_proposals,
                "zero_density": float(np.mean([fold.zero_density for fold in folds])),
            },
            doubts=(
                *_check(n_effective, se_draws, se_proposals, gap),
                *sorted({fold.disagreement for fold in folds if fold.disagreement})[-1:],
            ),
            shortfall=shortfall(
                self.target_se,
                se_draws,
                se_proposals,
                n_draws,
                "reparametrise towards a Gaussian posterior, or use importance sampling",
            ),
        )


@dataclass(frozen=True)
class _Fold:
    """The estimate from one half of the draws."""

    log_evidence: float
    draws: LogMean
    proposals: LogMean
    common: float  # part of the draws' error that is common to both halves
    n_effective: float  # effective number of draws
    zero_density: float  # fraction of the proposals
    disagreement: str  # of the chains, about the averaged terms


def _errors(folds: Sequence[_Fold]) -> tuple[float, float]:
    """Errors of the average, from the draws and from the proposals."""
    common = math.prod(fold.common for fold in folds)
    se_draws = math.sqrt(sum(fold.draws.error**2 for fold in folds) + 2 * common) / 2
    return se_draws, math.hypot(*(fold.proposals.error for fold in folds)) / 2


def _bridge(averaged: Posterior, q: NormalProposals, n_proposals: int, pooled: Whitening) -> _Fold:
    """Bridge from draws to the first proposals of q, fitted to other draws.

    `pooled` is the normal distribution fitted to all draws.
    """
    proposals, at_proposals = q.first(n_proposals)
    check_overlap(at_proposals)
    normal = _normal(q.moments)
    flat, log_density = averaged.draws.reshape(-1, proposals.shape[1]), averaged.log_density
    log_q = normal.logpdf(flat).reshape(log_density.shape)
    log_pooled = _normal(pooled).logpdf(flat).reshape(log_density.shape)
    return _bridge_ratios(
        log_density - log_q,
        at_proposals - normal.logpdf(proposals),
        pooled=log_density - log_pooled,
    )


def _bridge_ratios(at_draws: Array, at_proposals: Array, *, pooled: Array) -> _Fold:
    """Bridge from log-ratios l = f - ln q at draws (chain, draw) to those at proposals (m,).

    `pooled` is what `at_draws` would be under the q fitted to all draws.
    """
    from arviz_stats import ess  # loads much: see `importance`

    log_odds = math.log(at_draws.size / at_proposals.size)
    shift = log_odds - bridge_constant(at_draws, at_proposals, log_odds)
    # One fixed-point step suffices: the effective sample size depends only weakly on itself.
    n_effective = float(ess(expit(-at_draws - shift), method="mean"))
    log_odds = math.log(n_effective / at_proposals.size)
    log_evidence = bridge_constant(at_draws, at_proposals, log_odds)
    shift = log_odds - log_evidence

    terms = expit(-at_draws - shift)
    draws = log_mean_of_draws(log_expit(-at_draws - shift))
    moved = mcse_of_chains(terms - expit(-pooled - shift)) / float(terms.mean())
    return _Fold(
        log_evidence,
        draws=draws,
        proposals=log_mean_of_independent(log_expit(at_proposals + shift)),
        common=min(moved, draws.error),
        n_effective=n_effective,
        zero_density=float(np.isneginf(at_proposals).mean()),
        disagreement=disagreement(at_draws),
    )


def _normal(fitted: Whitening) -> Any:
    return multivariate_normal(fitted.mean, Covariance.from_cholesky(fitted.chol))


def _check(n_effective: float, se_draws: float, se_proposals: float, gap: float) -> Iterator[str]:
    """Check the effective sample size, both errors and the gap between the halves."""
    if n_effective < MIN_EFFECTIVE:
        yield (
            f"the draws have an effective number of {n_effective:.0f}, fewer than "
            f"{MIN_EFFECTIVE}: draw more"
        )
    if max(se_draws, se_proposals) > MAX_ERROR:
        yield (
            f"draws and proposals hardly overlap (errors of {se_draws:.2f} nats from the draws, "
            f"{se_proposals:.2f} from the proposals): draw more, or reparametrise towards a "
            "Gaussian posterior"
        )
    if gap > MAX_GAP:
        yield f"the halves of the draws differ by {gap:.1f} standard errors: draw more"
