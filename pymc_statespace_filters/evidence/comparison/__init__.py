"""Model probabilities from evidences, their prior sensitivity, and model averages."""

from pymc_statespace_filters.evidence.comparison.averaging import average_models
from pymc_statespace_filters.evidence.comparison.compare import (
    DimensionCorrection,
    compare_evidence,
)
from pymc_statespace_filters.evidence.comparison.marginal_modes import marginal_modes
from pymc_statespace_filters.evidence.comparison.prior_sensitivity import prior_sensitivity

__all__ = [
    "DimensionCorrection",
    "average_models",
    "compare_evidence",
    "marginal_modes",
    "prior_sensitivity",
]
