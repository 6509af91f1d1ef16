"""What can be doubtful about an evidence whatever the estimator."""

from pymc_statespace_filters.evidence.checks.convergence import doubts_of_draws
from pymc_statespace_filters.evidence.checks.discretisation import doubts_of_steps

__all__ = ["doubts_of_draws", "doubts_of_steps"]
