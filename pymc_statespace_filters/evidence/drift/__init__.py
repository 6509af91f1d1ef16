"""Is a parameter constant or does it drift: Bayes factors from draws of the drifting model."""

from .drift_evidence import drift_evidence

__all__ = ["drift_evidence"]
