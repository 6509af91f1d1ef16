r"""Importance sampling from a mixture of Student-t laws that was fitted to the draws.

.. math::

    p(D) = E_{x \sim q}[e^{f(x)} / q(x)], \qquad f = \log \text{prior} + \log \text{likelihood}.

The draws of the posterior only say where to look. Proposals are independent of them and of each
other, so that the mean is unbiased for any q that covers the posterior, several modes included, and
its error is that of independent terms. With a noisy likelihood every proposal has a fresh estimate,
and unbiased estimates of the likelihood give an unbiased evidence.

What can go wrong is a q that is low where the posterior is not: then a few weights, or one not yet
met, carry the mean. The shape k of a Pareto law fitted to the largest weights tells: above 0.7 the
error cannot be trusted (Vehtari, Simpson, Gelman, Yao and Gabry 2024). The weights themselves are
averaged as they are, for smoothed ones would be biased.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pymc_statespace_filters.errors import DataMismatchError
from pymc_statespace_filters.evidence.estimators.protocol import Estimate
from pymc_statespace_filters.evidence.estimators.student_mixture import choose_mixture
from pymc_statespace_filters.evidence.log_mean import (
    MIN_EFFECTIVE,
    log_mean_of_independent,
    pareto_k,
)
from pymc_statespace_filters.evidence.posterior.draws import Posterior

FEWEST_PROPOSALS, MOST_PROPOSALS = 1000, 10_000
MAX_PARETO_K = 0.7


@dataclass(frozen=True)
class Importance:
    """Importance sampling from a mixture of Student-t laws fitted to the draws.

    As many proposals as there are draws, at least 1000 and at most 10 000.

    Examples
    --------
    >>> from pymc_statespace_filters.evidence.estimators.importance import Importance
    >>> Importance()
    Importance()
    """

    name: ClassVar[str] = "importance"

    def n_evaluations(self, posterior: Posterior) -> int:
        """The number of proposals."""
        return min(max(posterior.log_density.size, FEWEST_PROPOSALS), MOST_PROPOSALS)

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence from draws and a log-density that can be evaluated."""
        n_proposals = self.n_evaluations(posterior)
        q = choose_mixture(posterior, rng)
        proposals = q.sample(n_proposals, rng)
        log_density = posterior.evaluate(proposals, rng)
        if np.isneginf(log_density).all():
            raise DataMismatchError(
                f"none of {n_proposals} proposals around the draws has a density: idata belongs "
                "to another model or to other data"
            )
        log_weights = log_density - q.log_density(proposals)
        evidence = log_mean_of_independent(log_weights)
        tail = pareto_k(log_weights)
        n_effective = evidence.kish_ess(n_proposals)
        return Estimate(
            log_evidence=evidence.value,
            se=evidence.error,
            settings={
                "n_proposals": n_proposals,
                "n_components": len(q.weights),
                "n_effective_proposals": n_effective,
                "pareto_k": tail,
                "zero_density": float(np.isneginf(log_density).mean()),
            },
            doubts=tuple(_doubts(n_effective, tail)),
        )


def _doubts(n_effective: float, tail: float) -> Iterator[str]:
    """Reasons for doubt, from what the proposals are worth and the tail of their weights."""
    if n_effective < MIN_EFFECTIVE:
        yield (
            f"the proposals are worth {n_effective:.0f} independent draws, fewer than "
            f"{MIN_EFFECTIVE}: use bridge sampling, or give the parameters a scale on which their "
            "posterior is nearer to a Gaussian"
        )
    if not tail <= MAX_PARETO_K:
        yield (
            f"the largest weights have a heavy tail (Pareto k {tail:.2f}, above "
            f"{MAX_PARETO_K}), so that larger ones may have been missed: the posterior has mass "
            "where there are few draws, or a sharp edge; draw more, or use bridge sampling"
        )
