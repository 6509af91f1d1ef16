"""Model probabilities from evidences, their prior sensitivity, and model averages."""

from .averaging import average_models
from .compare import DimensionCorrection, compare_evidence
from .marginal_modes import marginal_modes
from .prior_sensitivity import prior_sensitivity

__all__ = [
    "DimensionCorrection",
    "average_models",
    "compare_evidence",
    "marginal_modes",
    "prior_sensitivity",
]
