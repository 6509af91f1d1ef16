"""From the evidences of rival models to their probabilities, and to averages over them."""

from pymc_statespace_filters.evidence.choice.averaging import average_models
from pymc_statespace_filters.evidence.choice.comparison import (
    DimensionCorrection,
    compare_evidence,
)
from pymc_statespace_filters.evidence.choice.marginal_modes import marginal_modes
from pymc_statespace_filters.evidence.choice.sensitivity import prior_sensitivity

__all__ = [
    "DimensionCorrection",
    "average_models",
    "compare_evidence",
    "marginal_modes",
    "prior_sensitivity",
]
