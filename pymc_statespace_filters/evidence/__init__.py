"""Evidence of a model from its draws, and what follows for the choice between models."""

from pymc_statespace_filters.evidence.averaging import average_models
from pymc_statespace_filters.evidence.chib_jeliazkov import chib_jeliazkov
from pymc_statespace_filters.evidence.comparison import DimensionCorrection, compare_evidence
from pymc_statespace_filters.evidence.estimators import EvidenceEstimates, estimate_evidence
from pymc_statespace_filters.evidence.marginal_modes import marginal_modes
from pymc_statespace_filters.evidence.result import Evidence
from pymc_statespace_filters.evidence.sensitivity import prior_sensitivity

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
]
