"""What can be doubtful about an evidence before any estimator has begun."""

from collections.abc import Iterator

import arviz as az
import numpy as np

from pymc_statespace_filters.evidence.posterior import Posterior

MAX_RHAT = 1.05


def doubts_of_draws(posterior: Posterior) -> Iterator[str]:
    """Reasons why no estimate from these draws should be trusted: chains that disagree."""
    rhat = max(float(az.rhat(values)) for values in np.moveaxis(posterior.draws, -1, 0))
    if rhat > MAX_RHAT:
        yield f"the chains disagree (R-hat {rhat:.2f}): run them longer"
