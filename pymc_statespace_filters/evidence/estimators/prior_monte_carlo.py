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

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.estimators.protocol import Estimate
from pymc_statespace_filters.evidence.log_mean import MIN_EFFECTIVE, log_mean_of_independent
from pymc_statespace_filters.evidence.posterior.draws import Posterior
from pymc_statespace_filters.system.checks import check_count

MIN_DRAWS = 100


@dataclass(frozen=True)
class PriorMonteCarlo:
    """The mean likelihood of independent prior draws; posterior draws are not used.

    Parameters
    ----------
    n_draws : int
        Number of prior draws.

    Examples
    --------
    >>> from pymc_statespace_filters.evidence.estimators.prior_monte_carlo import PriorMonteCarlo
    >>> PriorMonteCarlo(n_draws=20_000)
    PriorMonteCarlo(n_draws=20000)
    """

    name: ClassVar[str] = "prior_monte_carlo"
    n_draws: int = 10_000

    def __post_init__(self) -> None:
        check_count("n_draws", self.n_draws, MIN_DRAWS)

    def n_evaluations(self, posterior: Posterior) -> int:
        """One per prior draw."""
        return self.n_draws

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence from prior draws.

        Raises
        ------
        ModelError
            If the prior is improper, or the likelihood is zero at all of its draws.
        """
        x = posterior.required_prior.sample(self.n_draws, rng)
        _, log_likelihood = posterior.evaluate_factors(x, rng)
        evidence = log_mean_of_independent(log_likelihood)
        if np.isneginf(evidence.value):
            raise ModelError(
                f"the likelihood is zero at all {self.n_draws} draws of the prior: narrow the "
                "priors to plausible values"
            )
        n_effective = evidence.kish_ess(self.n_draws)
        return Estimate(
            log_evidence=evidence.value,
            se=evidence.error,
            settings={"n_prior_draws": self.n_draws, "n_effective_prior_draws": n_effective},
            doubts=tuple(_check(n_effective)),
        )


def _check(n_effective: float) -> Iterator[str]:
    """Check Kish's effective number of draws."""
    if n_effective < MIN_EFFECTIVE:
        yield (
            f"the mean rests on {n_effective:.0f} draws of the prior, fewer than {MIN_EFFECTIVE}, "
            "and regions of high likelihood may have been missed: use an estimator that starts "
            "from posterior draws"
        )
