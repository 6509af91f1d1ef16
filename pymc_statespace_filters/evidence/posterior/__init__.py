"""The posterior and the prior of a model as arrays and functions, for evidence estimators."""

from .draws import Posterior, Prior

__all__ = ["Posterior", "Prior"]
