r"""The evidence by its definition: the mean likelihood of prior draws.

.. math::

    p(D) = E_{x \sim p(x)}[p(D|x)] \approx \frac{1}{N} \sum_{s=1}^{N} p(D|x_s)

(thesis, Eq. 3.6). Difference from the source: it multiplies each term by the prior once more,
although the draws come from the prior.

The terms are independent and the mean is unbiased, also with a noisy likelihood, estimated afresh
for each draw. Prior draws rarely hit the bulk of the posterior if there are many parameters: this
is a check of other estimators for few parameters.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ...errors import ModelError
from ...importance import MIN_EFFECTIVE, log_mean_of_independent
from ...system.checks import check_count
from ..posterior import Posterior
from .protocol import Estimate
from .stopping import check_target, is_small, shortfall, stands_still, totals

MIN_DRAWS = 100


@dataclass(frozen=True)
class PriorMonteCarlo:
    """The mean likelihood of independent prior draws; posterior draws are not used.

    Parameters
    ----------
    n_draws : int
        Number of prior draws; with a target, the most.
    target_se : float, optional
        Standard error to be reached: the number of draws is doubled from 1000 until it is.

    Examples
    --------
    >>> from pymc_statespace_filters.evidence.estimators.prior_monte_carlo import PriorMonteCarlo
    >>> PriorMonteCarlo(n_draws=20_000)
    PriorMonteCarlo(n_draws=20000, target_se=None)
    """

    name: ClassVar[str] = "prior_monte_carlo"
    uses_draws: ClassVar[bool] = False
    n_draws: int = 10_000
    target_se: float | None = None

    def __post_init__(self) -> None:
        check_count("n_draws", self.n_draws, MIN_DRAWS)
        check_target(self.target_se)

    def n_evaluations(self, posterior: Posterior) -> int:
        """One per prior draw; with a target, the fewest."""
        return next(self._totals(posterior))

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence from prior draws.

        Raises
        ------
        ModelError
            If the prior is improper, or the likelihood is zero at all of its draws.
        """
        log_likelihood, n_effective = np.empty(0), 0.0
        for n_draws in self._totals(posterior):
            x = posterior.required_prior.sample(n_draws - len(log_likelihood), rng)
            log_likelihood = np.append(log_likelihood, posterior.evaluate_factors(x, rng)[1])
            evidence = log_mean_of_independent(log_likelihood)
            former, n_effective = n_effective, evidence.kish_ess(n_draws)
            if is_small(self.target_se, 0.0, evidence.error) or stands_still(former, n_effective):
                break
        if np.isneginf(evidence.value):
            raise ModelError(
                f"the likelihood is zero at all {n_draws} draws of the prior: "
                f"{posterior.why_zero(x)}"
            )
        return Estimate(
            log_evidence=evidence.value,
            se=evidence.error,
            settings={"n_prior_draws": n_draws, "n_effective_prior_draws": n_effective},
            doubts=tuple(_check(n_effective)),
            shortfall=shortfall(
                self.target_se,
                0.0,
                evidence.error,
                posterior.log_density.size,
                "raise n_draws of PriorMonteCarlo, or narrow the priors",
            ),
        )

    def _totals(self, posterior: Posterior) -> Iterator[int]:
        if self.target_se is None:
            return iter((self.n_draws,))
        return totals(posterior, self.target_se, self.n_draws)


def _check(n_effective: float) -> Iterator[str]:
    """Check Kish's effective number of draws."""
    if n_effective < MIN_EFFECTIVE:
        yield (
            f"the mean rests on {n_effective:.0f} draws of the prior, fewer than {MIN_EFFECTIVE}, "
            "and regions of high likelihood may have been missed: use an estimator that starts "
            "from posterior draws"
        )
