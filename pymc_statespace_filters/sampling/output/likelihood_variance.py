"""Variance of an estimated log-likelihood over noise seeds, and its effect on a chain.

Let the log-likelihood at a point be estimated with variance v. If the errors are Gaussian, a chain
that keeps its estimates accepts the fraction ``2 Phi(-sqrt(v / 2)) = erfc(sqrt(v) / 2)`` of the
moves that it would accept with an exact likelihood (the error of the kept estimate is distributed
as N(v/2, v), that of a new one as N(-v/2, v)): 48 % at v = 1, 20 % at v = 3.3, 2.5 % at v = 10.
Noise costs moves, and particles cost time; per unit of time the best v lies between 1 and 3.3.

`sample_dram` measures the variance three times: where the search for starts has ended, at each
start, and after the run at the draw of highest density.

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
from scipy.special import stdtrit

from ..kernel.state import LOG_DENSITY, Draws, Evaluation, draw_seeds, side_generator
from ..target.sampled_model import SampledModel

# The variances between which a chain gains most per unit of time, and their geometric mean.
TARGET = (1.0, 3.3)
MIDDLE = math.sqrt(TARGET[0] * TARGET[1])
# Above the first a chain makes fewer than one in forty of its moves and stays long at
# overestimates; below the second the noise costs an eighth of the moves, while a thirtieth of the
# particles would suffice.
TOO_NOISY, TOO_QUIET = 10.0, 0.05
# Below this the estimate is exact, as that of a guided filter on a linear system.
ROUNDING = 1e-12

# Two-sided probability of the intervals.
_CONFIDENCE = 0.95
# Fewest estimates from which a variance is computed.
_FEWEST = 3

# Estimates at a point in a run: enough to know their variance within a factor of two or three.
N_SEEDS = 12
# Iterations of a chain from which these estimates are 2 % of its evaluations at most.
LEAST_ITERATIONS = 600
# In the tail, where a start may lie, estimates vary more, and most chains leave it during warm-up.
# At this variance the noise alone accepts one move in ten thousand, and a warm-up ends before.
HOPELESS = 30.0
# Iterations without a single move after which the warning about the start is given.
N_STUCK = 100


class SeedSpread(NamedTuple):
    """Moments of the estimates of the log-density at one point, over noise seeds."""

    n: int  # finite estimates, of which the moments are taken
    mean: float  # minus infinity if fewer than three are finite
    variance: float  # infinity if fewer than three are finite
    variance_low: float  # ends of a 95 % interval for the variance
    variance_high: float
    n_failed: int  # estimates that are minus infinity
    of: str = ""  # what was estimated, if not the likelihood of all data: " of record 'a'"


def seed_spread(
    log_density: Callable[..., Evaluation],
    position: np.ndarray,
    others: Sequence[np.ndarray],
    seeds: np.ndarray,
) -> SeedSpread:
    """Measure the spread of the estimates at one point, one for each row of seeds (R, noisy).

    ``log_density(position, others, seeds)`` gives an `Evaluation`, such as `BoundLogDensity`.
    """
    rows = (tuple(np.asarray(seed) for seed in row) for row in seeds)
    return spread_of(np.array([log_density(position, others, row).log_density for row in rows]))


def spread_of(estimates: np.ndarray) -> SeedSpread:
    """Summarise estimates, shape (R,), some of which may be minus infinity.

    The interval is the jackknife interval of the log-variance: estimates of a log-likelihood are
    skewed, and the chi-square interval for Gaussian samples would be too short.
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
    if without_one.min() <= 1e-12 * squares.sum():  # all of the variance is due to one estimate
        return SeedSpread(n, mean, variance, 0.0, np.inf, n_failed)
    error = math.sqrt((n - 1) * np.log(without_one).var())
    factor = math.exp(min(700.0, stdtrit(n - 1, 0.5 + 0.5 * _CONFIDENCE) * error))
    return SeedSpread(n, mean, variance, variance / factor, variance * factor, n_failed)


def acceptance_share(variance: float) -> float:
    """Fraction of an exact likelihood's accepted moves that noise of this variance accepts.

    Exact for Gaussian errors if the exact likelihood accepts every move; otherwise a lower bound:
    the acceptance rate with noise is at least this times the rate without.
    """
    return math.erfc(0.5 * math.sqrt(variance))


def is_measured(target: SampledModel, n_iterations: int) -> bool:
    """Whether a run measures the variance: with fresh noise, and unless it is short."""
    noisy = target.seed_names and target.settings.refresh_noise
    return bool(noisy) and n_iterations >= LEAST_ITERATIONS


def spread_at_highest_draw(
    draws: Sequence[Draws],
    tune: int,
    measure: Callable[[np.ndarray, np.ndarray], SeedSpread],
    keys: Sequence[np.ndarray],
    n_seeds: int,
) -> tuple[int, SeedSpread]:
    """Measure the variance at the draw of highest density after the warm-up, and name its chain.

    The estimate there is an overestimate, but the point is typical of the centre.
    """
    densities = [of_chain.numbers[tune:, LOG_DENSITY] for of_chain in draws]
    chain = int(np.argmax([of_chain.max() for of_chain in densities]))
    row = tune + int(densities[chain].argmax())
    # From the chain's key, which a checkpoint stores: a resumed run measures the same.
    seeds = draw_seeds(side_generator(keys[chain]), (N_SEEDS, n_seeds))
    return chain, measure(draws[chain].positions[row], seeds)
