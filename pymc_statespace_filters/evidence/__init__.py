"""Evidence of a model from posterior draws, and model comparison by evidence."""

from pymc_statespace_filters.evidence.comparison import (
    DimensionCorrection,
    average_models,
    compare_evidence,
    marginal_modes,
    prior_sensitivity,
)
from pymc_statespace_filters.evidence.estimation import (
    EvidenceEstimates,
    chib_jeliazkov,
    estimate_evidence,
)
from pymc_statespace_filters.evidence.evidence import Evidence
from pymc_statespace_filters.evidence.shorter_steps import step_error

__all__ = [
    "DimensionCorrection",
    "Evidence",
    "EvidenceEstimates",
    "average_models",
    "chib_jeliazkov",
    "compare_evidence",
    "estimate_evidence",
    "marginal_modes",
    "prior_sensitivity",
    "step_error",
]
