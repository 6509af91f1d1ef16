"""Which parameter varies, and when: tests of constancy from the scores of the terms."""

from .scan import drift_scan

__all__ = ["drift_scan"]
