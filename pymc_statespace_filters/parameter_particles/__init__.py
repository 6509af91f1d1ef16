"""Posteriors by particles of the parameters, led from the prior through the data."""

from .compare_prequential import compare_prequential
from .extend import extend
from .sample_smc import sample_smc

__all__ = ["compare_prequential", "extend", "sample_smc"]
