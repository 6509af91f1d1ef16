"""Convergence of the chains, on which every estimate from their draws relies."""

from collections.abc import Iterator

import arviz as az
import numpy as np

from pymc_statespace_filters.evidence.posterior.draws import Posterior

MAX_RHAT = 1.05


def check_convergence(posterior: Posterior) -> Iterator[str]:
    """Yield a reason to distrust every estimate if the chains disagree."""
    with np.errstate(invalid="ignore"):  # R-hat of a constant parameter is 0 / 0
        rhats = [float(az.rhat(values)) for values in np.moveaxis(posterior.draws, -1, 0)]
    rhat = max((one for one in rhats if not np.isnan(one)), default=1.0)
    if rhat > MAX_RHAT:
        yield f"the chains disagree (R-hat {rhat:.2f}): run them longer"
