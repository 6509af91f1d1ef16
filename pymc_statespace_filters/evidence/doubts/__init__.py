"""What can be doubtful about an evidence whatever the estimator."""

from pymc_statespace_filters.evidence.doubts.discretisation import doubts_of_steps
from pymc_statespace_filters.evidence.doubts.draws import doubts_of_draws

__all__ = ["doubts_of_draws", "doubts_of_steps"]
