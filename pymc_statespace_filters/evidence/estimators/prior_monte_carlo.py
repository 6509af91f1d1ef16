r"""The evidence as what it is by definition: the mean likelihood of draws of the prior.

.. math::

    p(D) = E_{x \sim p(x)}[p(D|x)] \approx \frac{1}{N} \sum_{s=1}^{N} p(D|x_s)

(thesis, Eq. 3.6). Difference from the source, which multiplies each term by the prior once more
although the draws come from it already.

The terms are independent and the mean is unbiased, with a noisy likelihood too, whose estimates are
fresh for each draw. But a draw of the prior meets the bulk of the posterior less often the more
parameters there are: this is a check of other estimators for few of them.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.estimators.protocol import Estimate
from pymc_statespace_filters.evidence.log_mean import MIN_EFFECTIVE, log_mean_of_independent
from pymc_statespace_filters.evidence.posterior.draws import Posterior

MIN_DRAWS = 100


@dataclass(frozen=True)
class PriorMonteCarlo:
    """The mean likelihood of independent draws of the prior; draws of the posterior are not used.

    Parameters
    ----------
    n_draws : int
        Of the prior.

    Examples
    --------
    >>> from pymc_statespace_filters.evidence.estimators.prior_monte_carlo import PriorMonteCarlo
    >>> PriorMonteCarlo(n_draws=20_000)
    PriorMonteCarlo(n_draws=20000)
    """

    name: ClassVar[str] = "prior_monte_carlo"
    n_draws: int = 10_000

    def __post_init__(self) -> None:
        given = self.n_draws
        if not (isinstance(given, int | np.integer) and given >= MIN_DRAWS):
            raise ModelError(f"n_draws must be an integer of at least {MIN_DRAWS}, got {given!r}")

    def n_evaluations(self, posterior: Posterior) -> int:
        """One for each draw of the prior."""
        return self.n_draws

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence from draws of the prior.

        Raises
        ------
        ModelError
            If the prior is improper, or if none of its draws has a likelihood.
        """
        x = posterior.required_prior.sample(self.n_draws, rng)
        _, log_likelihood = posterior.evaluate_factors(x, rng)
        evidence = log_mean_of_independent(log_likelihood)
        if np.isneginf(evidence.value):
            raise ModelError(
                f"none of {self.n_draws} draws of the prior has a likelihood: narrow the "
                "priors to values that the model can have"
            )
        n_effective = evidence.kish_ess(self.n_draws)
        return Estimate(
            log_evidence=evidence.value,
            se=evidence.error,
            settings={"n_prior_draws": self.n_draws, "n_effective_prior_draws": n_effective},
            doubts=tuple(_doubts(n_effective)),
        )


def _doubts(n_effective: float) -> Iterator[str]:
    """Reasons for doubt, from Kish's effective number of the draws."""
    if n_effective < MIN_EFFECTIVE:
        yield (
            f"{n_effective:.0f} draws of the prior carry the mean, fewer than {MIN_EFFECTIVE}, and "
            "better places may have been missed: use an estimator that goes where the posterior is"
        )
