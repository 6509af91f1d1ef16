"""Evidence of a model from posterior draws, and model comparison by evidence."""

from .comparison.averaging import average_models
from .comparison.compare import compare_evidence
from .comparison.prior_sensitivity import prior_sensitivity
from .drift.drift_evidence import drift_evidence
from .estimation import EvidenceEstimates, chib_jeliazkov, estimate_evidence
from .evidence import Evidence
from .reweighting.reweight import reweight
from .shorter_steps import step_error

__all__ = [
    "Evidence",
    "EvidenceEstimates",
    "average_models",
    "chib_jeliazkov",
    "compare_evidence",
    "drift_evidence",
    "estimate_evidence",
    "prior_sensitivity",
    "reweight",
    "step_error",
]
