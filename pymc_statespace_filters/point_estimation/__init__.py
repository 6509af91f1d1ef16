"""Point estimates of parameters, with the curvature of the likelihood and standard errors."""

from .estimate import MaximumLikelihoodEstimate
from .maximum_likelihood import maximum_likelihood

__all__ = ["MaximumLikelihoodEstimate", "maximum_likelihood"]
