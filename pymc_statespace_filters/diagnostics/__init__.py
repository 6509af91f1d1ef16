"""Diagnostics of filter and model by one-step-ahead prediction of the observations."""

from .constancy.scan import drift_scan
from .cross_validation import leave_future_out
from .filter_health import filter_diagnostics
from .likelihood_check import check_filter
from .pointwise_log_likelihood import compute_log_likelihood

__all__ = [
    "check_filter",
    "compute_log_likelihood",
    "drift_scan",
    "filter_diagnostics",
    "leave_future_out",
]
