"""Tables and error models of pharmacometrics, as arguments of a panel and of a system."""

from .system.clinical.panel import read_events
from .system.error_models import log_normal_error, normal_error

__all__ = ["log_normal_error", "normal_error", "read_events"]
