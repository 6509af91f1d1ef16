"""Model probabilities from evidences, their prior sensitivity, and model averages."""

from .averaging import average_models
from .compare import compare_evidence
from .prior_sensitivity import prior_sensitivity

__all__ = [
    "average_models",
    "compare_evidence",
    "prior_sensitivity",
]
