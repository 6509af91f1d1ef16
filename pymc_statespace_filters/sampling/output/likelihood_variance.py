"""How far the estimates of one likelihood scatter over noise seeds, and what that does to a chain.

Let the log-likelihood at a point be estimated with a variance v. If the errors are Gaussian, a
chain that keeps its estimates lets through the share ``2 Phi(-sqrt(v / 2)) = erfc(sqrt(v) / 2)``
of the moves that it would make with an exact likelihood (the error of the kept estimate is drawn
from N(v/2, v), that of a new one from N(-v/2, v)): 48 % at v = 1, 20 % at v = 3.3, 2.5 % at v = 10.
The noise costs moves, and particles cost time; per unit of time the best v lies between 1 and 3.3.

References
----------
A. Doucet, M. K. Pitt, G. Deligiannidis and R. Kohn (2015). Efficient implementation of Markov chain
Monte Carlo when using an unbiased likelihood estimator. Biometrika 102, 295-313.
C. Sherlock, A. H. Thiery, G. O. Roberts and J. S. Rosenthal (2015). On the efficiency of
pseudo-marginal random walk Metropolis algorithms. Annals of Statistics 43, 238-275.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student_t

from pymc_statespace_filters.sampling.kernel.state import Evaluation

# The variances between which a chain gains most for its time, and the middle of their logs.
TARGET = (1.0, 3.3)
MIDDLE = math.sqrt(TARGET[0] * TARGET[1])
# Above the first a chain makes fewer than one in forty of its moves and waits long on estimates
# that came out high; below the second the noise costs an eighth of the moves, while a thirtieth of
# the particles would do.
TOO_NOISY, TOO_QUIET = 10.0, 0.05

# Two-sided probability of the intervals.
_CONFIDENCE = 0.95
# Fewer estimates than this say nothing of their variance.
_FEWEST = 3


class SeedSpread(NamedTuple):
    """Estimates of the log-density at one point, over noise seeds.

    Attributes
    ----------
    n : int
        Estimates that are finite; the moments are theirs.
    mean, variance : float
        Minus infinity and infinity where fewer than three are finite.
    variance_low, variance_high : float
        A 95 % interval for the variance.
    n_failed : int
        Estimates that are minus infinity.
    """

    n: int
    mean: float
    variance: float
    variance_low: float
    variance_high: float
    n_failed: int


def seed_spread(
    log_density: Callable[..., Evaluation],
    position: np.ndarray,
    others: Sequence[np.ndarray],
    seeds: np.ndarray,
) -> SeedSpread:
    """Measure the spread of the estimates at one point.

    Parameters
    ----------
    log_density : callable
        ``(position, others, seeds) -> Evaluation``, such as `BoundDensity`.
    position : ndarray, shape (d,)
    others : sequence of ndarray
    seeds : ndarray of int64, shape (R, noisy)
        A row for each evaluation.

    Returns
    -------
    SeedSpread
    """
    rows = (tuple(np.asarray(seed) for seed in row) for row in seeds)
    return spread_of(np.array([log_density(position, others, row).log_density for row in rows]))


def spread_of(estimates: np.ndarray) -> SeedSpread:
    """Summarise estimates (R,), of which some may be minus infinity.

    The interval comes from the jackknife of the log-variance: log estimates of a likelihood are
    skewed, and the chi-square interval of Gaussian numbers would be too short.
    """
    finite = estimates[np.isfinite(estimates)]
    n, n_failed = finite.size, estimates.size - finite.size
    if n < _FEWEST:
        return SeedSpread(n, -np.inf, np.inf, 0.0, np.inf, n_failed)
    mean = float(finite.mean())
    squares = (finite - mean) ** 2
    variance = float(squares.sum()) / (n - 1)
    if variance == 0.0:
        return SeedSpread(n, mean, 0.0, 0.0, 0.0, n_failed)
    without_one = squares.sum() - squares * n / (n - 1)
    if without_one.min() <= 1e-12 * squares.sum():  # a single estimate makes all of the spread
        return SeedSpread(n, mean, variance, 0.0, np.inf, n_failed)
    error = math.sqrt((n - 1) * np.log(without_one).var())
    factor = math.exp(min(700.0, student_t.ppf(0.5 + 0.5 * _CONFIDENCE, n - 1) * error))
    return SeedSpread(n, mean, variance, variance / factor, variance * factor, n_failed)


def acceptance_share(variance: float) -> float:
    """Share of an exact likelihood's moves that noise of this variance lets through.

    Exact for Gaussian errors where the noise alone decides, and then a lower bound: the acceptance
    with the noise is at least this times the acceptance without.
    """
    return math.erfc(0.5 * math.sqrt(variance))


def spread_warning(spread: SeedSpread, where: str, chain: int) -> str | None:
    """Say what to do if the spread is far outside the range in which chains work best.

    Parameters
    ----------
    spread : SeedSpread
    where : str
        Where it was measured: "at the start".
    chain : int

    Returns
    -------
    str or None
        None between variances of 0.05 and 10, and without noise.
    """
    found = f"Chain {chain}, {where}: the estimated log-likelihood"
    if spread.n_failed > spread.n or spread.variance == np.inf:
        return (
            f"{found} failed for {spread.n_failed} of {spread.n + spread.n_failed} noise seeds. "
            "Start elsewhere (initvals), or give the filter more particles."
        )
    if spread.variance > TOO_NOISY:
        share = acceptance_share(spread.variance)
        return (
            f"{found} has a variance of {spread.variance:.3g} over {spread.n} noise seeds. "
            f"The noise lets through some {share:.1g} of the moves of an exact likelihood, and the "
            "chain waits long on estimates that came out high. The variance falls about as one "
            f"over the number of particles: {_rounded(spread.variance / MIDDLE)} times as many "
            f"would bring it between {TARGET[0]:g} and {TARGET[1]:g}; psf.suggest_particles(model) "
            "finds the number."
        )
    if 0.0 < spread.variance < TOO_QUIET:
        return (
            f"{found} has a variance of only {spread.variance:.2g} over {spread.n} noise seeds. "
            f"With some {_rounded(MIDDLE / spread.variance)} times fewer particles it would lie "
            f"between {TARGET[0]:g} and {TARGET[1]:g} and the chain would be faster for its time; "
            "psf.suggest_particles(model) finds the number."
        )
    return None


def _rounded(factor: float) -> str:
    """A factor in two digits, without an exponent."""
    digits = 1 - math.floor(math.log10(factor))
    return f"{round(factor, digits):.{max(0, digits)}f}"
