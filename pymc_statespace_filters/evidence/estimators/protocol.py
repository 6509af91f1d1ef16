"""What every estimator of the evidence gives, before it is reported as an `Evidence`."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from pymc_statespace_filters.evidence.posterior import Posterior


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


class Estimator(Protocol):
    """The evidence from draws of a posterior, and a log-density that can be evaluated."""

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence."""

    def n_evaluations(self, posterior: Posterior) -> int:
        """About how many evaluations of the log-density it will take."""
