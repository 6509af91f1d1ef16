"""The one check that both the package's filters and deliberately wrong ones are put to.

A filter is run with several seeds at several numbers of particles. Three things must hold: its
error shrinks at the stated rate, at the largest number its mean is within the stated bias, and its
scatter below the stated one. Means and rates are given four standard errors, so that a right
filter fails one check in about 10 000 (seeds are fixed: it passes always or never).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ALLOWED = 4.0  # standard errors


class Law(NamedTuple):
    """What is promised of the error of a total log-likelihood, in nats."""

    counts: tuple[int, ...]
    n_seeds: int
    bias: float  # largest absolute mean error at the last count
    scatter: float  # largest standard deviation at the last count
    slope: tuple[float, float]  # range of d log(root mean square error) / d log(count)


class Measured(NamedTuple):
    """Mean and standard deviation at each count, and the slope over all of them."""

    counts: tuple[int, ...]
    mean: Array
    mean_se: Array
    sd: Array
    slope: float
    slope_se: float


def measure(errors: Callable[[int, int], Array], law: Law) -> Measured:
    """Run `errors(count, n_seeds) -> (n_seeds,)` at each count."""
    samples = np.array([errors(count, law.n_seeds) for count in law.counts])
    sd = samples.std(axis=1, ddof=1)
    log_count = np.log(law.counts)
    log_rms = 0.5 * np.log((samples**2).mean(axis=1))
    centred = log_count - log_count.mean()
    # The logarithm of a root mean square of n normal errors has the variance 1 / (2 n).
    slope_se = 1.0 / np.sqrt(2.0 * law.n_seeds * (centred**2).sum())
    slope = (centred * log_rms).sum() / (centred**2).sum()
    mean_se = sd / np.sqrt(law.n_seeds)
    return Measured(law.counts, samples.mean(axis=1), mean_se, sd, float(slope), float(slope_se))


def violations(found: Measured, law: Law) -> list[str]:
    """The promises that do not hold, in words; an empty list is a pass."""
    low, high = law.slope
    bias, se, sd = found.mean[-1], found.mean_se[-1], found.sd[-1]
    checks = {
        f"bias {bias:.3f} +- {se:.3f}, allowed {law.bias}": abs(bias) <= law.bias + ALLOWED * se,
        f"scatter {sd:.3f}, allowed {law.scatter}": sd <= law.scatter,
        f"slope {found.slope:.2f} +- {found.slope_se:.2f}, allowed {law.slope}": (
            low - ALLOWED * found.slope_se <= found.slope <= high + ALLOWED * found.slope_se
        ),
    }
    return [what for what, holds in checks.items() if not holds]
