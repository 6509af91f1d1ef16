"""The thesis's correction for the number of parameters, as a prior over models."""

import math
from collections.abc import Mapping

from pymc_statespace_filters.evidence import Evidence


def dimension_prior(evidences: Mapping[str, Evidence], exponent: float) -> dict[str, float]:
    """Return weights proportional to J^(-k alpha / 2) (after Eq. 3.7); alpha is the exponent.

    k is the number of free scalar variables of a model and J its number of observations. With flat
    priors, 1 is the penalty of the Bayesian information criterion.
    """
    penalties = {
        name: exponent / 2 * one.n_parameters * math.log(one.n_observations)
        for name, one in evidences.items()
    }
    smallest = min(penalties.values())  # the largest weight is 1, so that not all underflow
    return {name: math.exp(smallest - penalty) for name, penalty in penalties.items()}
