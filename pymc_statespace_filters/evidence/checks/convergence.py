"""What can be doubtful about an evidence before any estimator has begun."""

from collections.abc import Iterator

import arviz as az
import numpy as np

from pymc_statespace_filters.evidence.posterior import Posterior

MAX_RHAT = 1.05


def doubts_of_draws(posterior: Posterior) -> Iterator[str]:
    """Reasons why no estimate from these draws should be trusted: chains that disagree."""
    with np.errstate(invalid="ignore"):  # no R-hat of a parameter that does not vary
        rhats = [float(az.rhat(values)) for values in np.moveaxis(posterior.draws, -1, 0)]
    rhat = max((one for one in rhats if not np.isnan(one)), default=1.0)
    if rhat > MAX_RHAT:
        yield f"the chains disagree (R-hat {rhat:.2f}): run them longer"
