"""Posteriors by particles of the parameters, led from the prior through the data."""

from .extend import extend
from .sample_smc import sample_smc

__all__ = ["extend", "sample_smc"]
