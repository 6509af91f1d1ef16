"""The posterior and the prior of a model as arrays and functions, for evidence estimators."""

from pymc_statespace_filters.evidence.posterior.draws import Posterior, Prior

__all__ = ["Posterior", "Prior"]
