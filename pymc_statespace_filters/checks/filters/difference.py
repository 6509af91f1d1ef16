"""The mean difference of two filters' log-likelihoods, and how far it varies."""

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, stdtrit

from .estimates import Estimates
from .finding import ALPHA


class Difference(NamedTuple):
    """Filter minus reference at n draws: the mean, its standard error, and the spread.

    The spread is the standard deviation without the part that is due to the noise of both.
    """

    n: int
    mean: float
    se: float
    spread: float

    @property
    def margin(self) -> float:
        """Half of the confidence interval of the mean."""
        return float(stdtrit(max(self.n - 1, 1), 1.0 - ALPHA / 2.0) * self.se)

    @property
    def least_spread(self) -> float:
        """The lower end of an interval for the spread, as if differences were normal."""
        dof = max(self.n - 1, 1)
        return float(self.spread * np.sqrt(dof / chdtri(dof, ALPHA)))

    @property
    def most_spread(self) -> float:
        """The upper end, with the noise: no parameter is moved by more standard deviations."""
        dof = max(self.n - 1, 1)
        return float(self.se * np.sqrt(self.n * dof / chdtri(dof, 1.0 - ALPHA)))


def difference(checked: Estimates, reference: Estimates) -> Difference:
    """At the points where both are known."""
    values = checked.mean - reference.mean
    known = np.isfinite(values)
    noise = float(np.mean((checked.error**2 + reference.error**2)[known])) if known.any() else 0.0
    n = int(known.sum())
    if n < 2:
        return Difference(n, np.nan, np.inf, np.nan)
    variance = float(values[known].var(ddof=1))
    spread = np.sqrt(max(variance - noise, 0.0))
    return Difference(n, float(values[known].mean()), np.sqrt(max(variance, noise) / n), spread)
