r"""Bridge sampling to a normal distribution (Meng and Wong 1996), optionally warped.

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

Warp-III (Meng and Schilling 2002) brings the posterior nearer to q: it is standardised by the mean
m and covariance of the draws and reflected at random about m, so that its kernel becomes the
average of the two mirror images, [e^f(x) + e^f(2m - x)] / 2. The average is symmetric like q and
has the same integral; it costs an evaluation at the mirror image of every draw and proposal.

Differences from the sources. The fixed point is bracketed instead of iterated: the equation is
monotone in ln p(D), and the iteration is slow if the two distributions hardly overlap. The
estimator is cross-fitted: q fitted to one half of every chain is used with the draws of the other
half, and the two estimates are averaged, because q overlaps too well with the draws to which it was
fitted. The two estimates are not independent: if the halves differ, each sees the other's q
displaced by the same amount. This part of their errors is measured by the change of the terms under
a q fitted to all draws, and counted as common to both.

With a noisy likelihood, f of a draw is the estimate stored by the chain, and f of a new point is a
fresh estimate. The identity then holds on the space of x and noise, with q times the distribution
of the noise in place of q. The reflection of warp-III swaps the noises of a point and its image: a
draw has the noise of the chain, its image fresh noise.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, log_expit
from scipy.stats import Covariance, multivariate_normal

from ...importance import (
    MIN_EFFECTIVE,
    LogMean,
    bridge_constant,
    disagreement,
    log_mean_of_independent,
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
    warped : bool
        Whether to reflect the posterior about its mean at random (warp-III, Meng and Schilling
        2002). This suits skewed posteriors and takes three times as many evaluations.
    target_se : float, optional
        Standard error to be reached. The number of proposals is doubled from 1000 to at most 16 000
        until it is, or until the error of the draws dominates. By default it is the number of
        draws, within 1000 to 10 000. Warped, as many draws are reflected.

    Examples
    --------
    >>> from pymc_statespace_filters.evidence.estimators.bridge import Bridge
    >>> Bridge(warped=True)
    Bridge(warped=True, target_se=None)
    """

    warped: bool = False
    target_se: float | None = None

    def __post_init__(self) -> None:
        check_target(self.target_se)

    @property
    def name(self) -> str:
        """``"bridge"`` or ``"warp_bridge"``."""
        return "warp_bridge" if self.warped else "bridge"

    def n_evaluations(self, posterior: Posterior) -> int:
        """One per proposal; warped, also one per mirror image. With a target, the fewest."""
        return next(totals(posterior, self.target_se)) * (3 if self.warped else 1)

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence from the draws and further log-density evaluations."""
        pooled = moments(posterior.draws)
        proposals = normal_proposals(posterior, rng)
        halves = reversed(posterior.halves())  # those to be averaged
        samples = [
            (_Warped if self.warped else _Plain)(q, averaged, pooled)
            for q, averaged in zip(proposals, halves, strict=True)
        ]
        for n_proposals in totals(posterior, self.target_se):
            folds = [sample.bridged(n_proposals // 2, rng) for sample in samples]
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
                *posterior.worst_disagreement(fold.disagreement for fold in folds),
            ),
            shortfall=shortfall(
                self.target_se,
                se_draws,
                se_proposals,
                n_draws,
                "reparametrise towards a Gaussian posterior, or use importance sampling",
            ),
        )


class _Plain:
    """One half of the draws, and proposals fitted to the other half, evaluated as needed."""

    def __init__(self, q: NormalProposals, averaged: Posterior, pooled: Whitening) -> None:
        self._q, self._averaged, self._pooled = q, averaged, pooled

    def bridged(self, n_proposals: int, rng: np.random.Generator) -> "_Fold":
        """Bridge from the draws to the first proposals."""
        return _bridge(
            self._averaged,
            *self._q.first(n_proposals),
            q=self._q.moments,
            pooled=self._pooled,
        )


class _Warped:
    """The same with the average of the posterior and its mirror image about the mean of q."""

    def __init__(self, q: NormalProposals, averaged: Posterior, pooled: Whitening) -> None:
        self._q, self._averaged = q, averaged
        self._pooled = pooled._replace(mean=q.moments.mean)  # the reflection was about this mean
        self._image_of_draw = np.full(averaged.log_density.shape, np.nan)
        self._image_of_proposal = np.empty(0)

    def bridged(self, n_proposals: int, rng: np.random.Generator) -> "_Fold":
        """Bridge from about as many draws, thinned evenly, to the first proposals."""
        proposals, at_proposals = self._q.first(n_proposals)
        known = len(self._image_of_proposal)
        images = self._evaluate_images(proposals[known:], rng)
        self._image_of_proposal = np.append(self._image_of_proposal, images)

        # Powers of two: the draws of a longer step are among those of a shorter one.
        step = 1
        while self._averaged.log_density.size > 1.1 * step * n_proposals:
            step *= 2
        chosen = np.zeros(self._image_of_draw.shape, dtype=bool)
        chosen[:, ::step] = True
        new = chosen & np.isnan(self._image_of_draw)
        self._image_of_draw[new] = self._evaluate_images(self._averaged.draws[new], rng)
        averaged = self._averaged.every(step)
        at_both = np.logaddexp(averaged.log_density, self._image_of_draw[:, ::step])
        return _bridge(
            replace(averaged, log_density=at_both - math.log(2)),
            proposals,
            np.logaddexp(at_proposals, self._image_of_proposal) - math.log(2),
            q=self._q.moments,
            pooled=self._pooled,
        )

    def _evaluate_images(self, x: Array, rng: np.random.Generator) -> Array:
        return self._averaged.evaluate(2 * self._q.moments.mean - x, rng)


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


def _bridge(
    averaged: Posterior,
    proposals: Array,
    at_proposals: Array,
    *,
    q: Whitening,
    pooled: Whitening,
) -> _Fold:
    """Bridge from draws to proposals (m, k), given their log-densities.

    `pooled` is the normal distribution fitted to all draws.
    """
    check_overlap(at_proposals)
    normal = _normal(q)
    flat, log_density = averaged.draws.reshape(-1, len(q.mean)), averaged.log_density
    log_q = normal.logpdf(flat).reshape(log_density.shape)
    log_pooled = _normal(pooled).logpdf(flat).reshape(log_density.shape)
    return _bridge_ratios(
        log_density - log_q,
        at_proposals - normal.logpdf(proposals),
        pooled=log_density - log_pooled,
        averaged=averaged,
    )


def _bridge_ratios(
    at_draws: Array, at_proposals: Array, *, pooled: Array, averaged: Posterior
) -> _Fold:
    """Bridge from log-ratios l = f - ln q at draws (chain, draw) to those at proposals (m,).

    `pooled` is what `at_draws` would be under the q fitted to all draws.
    """
    log_odds = math.log(at_draws.size / at_proposals.size)
    shift = log_odds - bridge_constant(at_draws, at_proposals, log_odds)
    # One fixed-point step suffices: the effective sample size depends only weakly on itself.
    n_effective = averaged.ess(expit(-at_draws - shift))
    log_odds = math.log(n_effective / at_proposals.size)
    log_evidence = bridge_constant(at_draws, at_proposals, log_odds)
    shift = log_odds - log_evidence

    terms = expit(-at_draws - shift)
    draws = averaged.log_mean(log_expit(-at_draws - shift))
    moved = averaged.mcse(terms - expit(-pooled - shift)) / float(terms.mean())
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
