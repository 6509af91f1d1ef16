r"""Importance sampling from a mixture of Student-t distributions fitted to the draws.

.. math::

    p(D) = E_{x \sim q}[e^{f(x)} / q(x)], \qquad f = \log \text{prior} + \log \text{likelihood}.

The draws of the posterior serve only to fit q. Given q the proposals are independent, so that the
mean is unbiased for any q that covers the posterior, several modes included, and its error is that
of independent terms. With a noisy likelihood every proposal gets a fresh estimate, and unbiased
likelihood estimates give an unbiased evidence.

The method fails if q is low where the posterior is not: a few large weights, or one not yet
sampled, then dominate the mean. Two diagnostics show it. One is the shape k of a generalised Pareto
distribution fitted to the largest weights: above 0.7 the error is unreliable (Vehtari, Simpson,
Gelman, Yao and Gabry 2024). The weights are not smoothed, because that would bias the mean.

The other is the share u of the draws whose weight exceeds that of every proposal. About this share
of the posterior has not been sampled, whatever the weights that have been: the neck of a funnel
leaves no trace among the proposals. The mean is then too low by about u, which is therefore a part
of the standard error.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ...statistics.importance import MAX_PARETO_K, MIN_EFFECTIVE, log_mean_of_independent, pareto_k
from ..posterior import Posterior, check_overlap
from .protocol import Estimate
from .stopping import check_target, is_small, shortfall, stands_still, totals
from .student_mixture import choose_mixture

MOST_COMPARED = 10_000  # draws whose weights are compared with those of the proposals


@dataclass(frozen=True)
class Importance:
    """Importance sampling from a mixture of Student-t distributions fitted to the draws.

    Parameters
    ----------
    target_se : float, optional
        Standard error to be reached. The number of proposals is doubled from 1000 to at most 16 000
        until it is, or until their effective number is small and no longer grows. By default it is
        the number of draws, within 1000 to 10 000.

    Examples
    --------
    >>> from pymc_statespace_filters.evidence.estimators.importance import Importance
    >>> Importance(target_se=0.02)
    Importance(target_se=0.02)
    """

    name: ClassVar[str] = "importance"
    target_se: float | None = None

    def __post_init__(self) -> None:
        check_target(self.target_se)

    def n_evaluations(self, posterior: Posterior) -> int:
        """The number of proposals; with a target, the fewest."""
        return next(totals(posterior, self.target_se))

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence from a fit to the draws and fresh log-densities."""
        q = choose_mixture(posterior, rng)
        compared = posterior.thinned(MOST_COMPARED)
        draws = compared.draws.reshape(-1, compared.draws.shape[-1])
        of_draws = compared.log_density.ravel() - q.log_density(draws)
        log_weights, n_effective = np.empty(0), 0.0
        for n_proposals in totals(posterior, self.target_se):
            proposals = q.sample(n_proposals - len(log_weights), rng)
            log_density = posterior.evaluate(proposals, rng)
            log_weights = np.append(log_weights, log_density - q.log_density(proposals))
            check_overlap(log_weights)
            evidence = log_mean_of_independent(log_weights)
            unsampled = float((of_draws > log_weights.max()).mean())
            se = math.hypot(evidence.error, unsampled)
            former, n_effective = n_effective, evidence.kish_ess(n_proposals)
            if is_small(self.target_se, 0.0, se) or stands_still(former, n_effective):
                break
        tail = pareto_k(log_weights)
        return Estimate(
            log_evidence=evidence.value,
            se=se,
            settings={
                "n_proposals": n_proposals,
                "n_components": len(q.weights),
                "n_effective_proposals": n_effective,
                "pareto_k": tail,
                "unsampled": unsampled,
                "zero_density": float(np.isneginf(log_weights).mean()),
            },
            doubts=tuple(_check(n_effective, tail, unsampled, evidence.error, posterior.remedy)),
            shortfall=shortfall(
                self.target_se,
                0.0,
                se,
                posterior.log_density.size,
                f"draw more, for proposals that fit better, or {posterior.remedy}",
            ),
        )


def _check(
    n_effective: float, tail: float, unsampled: float, error: float, remedy: str
) -> Iterator[str]:
    """Check the number of proposals, the tail of their weights, and those of the draws beyond."""
    if unsampled > error:
        yield (
            f"{unsampled:.1%} of the draws have a weight above that of every proposal: that part "
            f"of the posterior has not been sampled; {remedy}, or reparametrise towards a Gaussian "
            "posterior"
        )
    if n_effective < MIN_EFFECTIVE:
        yield (
            f"the proposals have an effective number of {n_effective:.0f}, fewer than "
            f"{MIN_EFFECTIVE}: {remedy}, or reparametrise towards a Gaussian posterior"
        )
    if not tail <= MAX_PARETO_K:
        yield (
            f"the largest weights have a heavy tail (Pareto k {tail:.2f}, above {MAX_PARETO_K}): "
            "the posterior has mass where there are few draws, or a sharp edge; draw more, or "
            f"{remedy}"
        )
