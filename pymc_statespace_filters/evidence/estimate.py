"""What every estimator of the evidence gives, before it is reported as an `Evidence`."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Estimate:
    """A log-evidence, its error, and how they came about.

    Attributes
    ----------
    log_evidence : float
    se : float
        Numerical standard error; NaN if the estimator has none, as Laplace's.
    settings : mapping of str to float
        What the estimator chose and met: scales, counts, effective numbers.
    doubts : tuple of str
        Reasons why the error may be larger than it says, each with its cure.
    """

    log_evidence: float
    se: float
    settings: Mapping[str, float] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()
