"""Point estimates of parameters, with the curvature of the likelihood and standard errors."""

from pymc_statespace_filters.point_estimation.estimate import MaximumLikelihoodEstimate
from pymc_statespace_filters.point_estimation.maximum_likelihood import maximum_likelihood

__all__ = ["MaximumLikelihoodEstimate", "maximum_likelihood"]
