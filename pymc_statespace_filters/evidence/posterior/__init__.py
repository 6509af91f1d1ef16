"""The posterior and the prior of a model as numbers: what estimators integrate."""

from pymc_statespace_filters.evidence.posterior.density import ModelDensity, RowFunction
from pymc_statespace_filters.evidence.posterior.draws import Posterior, Prior, posterior_of

__all__ = [
    "ModelDensity",
    "Posterior",
    "Prior",
    "RowFunction",
    "posterior_of",
]
