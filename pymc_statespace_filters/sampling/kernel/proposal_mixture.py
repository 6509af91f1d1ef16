"""Fit the mixture of the independence proposals to draws of all chains, and choose its share.

The mixture is fitted to a population before warm-up, and to the later half of the draws of all
chains after each quarter of it. The number of components is the one under which held-out draws are
likeliest. The share of the iterations that make independence proposals follows the squared jumps
that they and the random walk have made for each evaluation, so that a mixture that does not fit
costs little.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...statistics.student_mixture import (
    StudentMixture,
    fit_mixture,
    likeliest_mixture,
    standardised,
)
from .independence import (
    CUMULATIVE,
    LOG_FACTOR,
    MEAN,
    MOST_COMPONENTS,
    N_COMPONENTS,
    SHARE,
    no_mixture,
    unpack_mixture,
)
from .state import INDEPENDENT, N_EVALUATIONS, N_SCREENED, STAGE, Draws

FIRST_SHARE = 0.5  # of a mixture not tried yet
LEAST_SHARE, MOST_SHARE = 0.2, 0.65  # the least while tuning, so that it goes on being tried
NO_SHARE = 0.05  # a smaller one is not worth its evaluations after warm-up
LEAST_ACCEPTANCE = 0.05  # of the mixture's proposals, else the share is as small as may be
# The same with an estimated likelihood: a variance of 3.3, at which chains still work well, takes
# four of five acceptances from walks and mixture alike.
LEAST_WITH_NOISE = 0.01
MIN_GAIN = 0.02  # nats per held-out draw, to accept a further component
FEWEST = 10  # different draws for each dimension, to fit at all
# Draws, as more take long. In many dimensions components need more, or are hardly their own.
MOST_FITTED, MOST_PER_DIMENSION = 2000, 200

Array = NDArray[np.float64]


def warmup_parts(tune: int) -> tuple[int, ...]:
    """Iterations after which the chains wait for each other and get a new mixture; last, all."""
    return tuple(sorted({tune // 4, tune // 2, 3 * tune // 4, tune} - {0}))


def improved_mixture(
    packed: Array,
    chains: Sequence[Draws],
    begin: int,
    end: int,
    rng: np.random.Generator,
    *,
    population: Array,
    thin: int,
    tuning: bool,
    is_noisy: bool,
) -> Array:
    """The packed mixture for the iterations from ``end`` on, given the one since ``begin``.

    It is fitted to the population (m, d), which may be empty, and one of ``thin`` of the later half
    of the draws.
    """
    least = LEAST_WITH_NOISE if is_noisy else LEAST_ACCEPTANCE
    share = next_share(packed[SHARE], chains, begin, end, least)
    draws = [chain.positions[end // 2 : end][::-thin] for chain in chains]
    fitted = fitted_mixture([population, *draws], rng)
    new = packed.copy() if fitted is None else fitted
    if new[N_COMPONENTS] > 0:
        new[SHARE] = max(share, LEAST_SHARE) if tuning else share
    return new


def next_share(
    share: float, chains: Sequence[Draws], begin: int, end: int, least_acceptance: float
) -> float:
    """The share, by the squared jumps for each evaluation in some iterations.

    They are a and b for the two kinds of proposals, in standard deviations of the draws; the share
    is a^2 / (a^2 + b^2), and 0 if fewer proposals of the mixture were accepted than the least. If
    one kind was not tried, it is `FIRST_SHARE`.
    """
    first = max(begin, 1)
    if end == first:  # one iteration, without one before it
        return share
    jumps = [np.diff(draws.positions[first - 1 : end], axis=0) for draws in chains]
    scales = np.concatenate([draws.positions[first:end] for draws in chains]).var(axis=0)
    moved = scales > 0
    squared = np.concatenate([(jump[:, moved] ** 2 / scales[moved]).sum(axis=1) for jump in jumps])
    counts = np.concatenate([draws.counts[first:end] for draws in chains])
    free = counts[:, INDEPENDENT] > 0
    cost = counts[:, N_EVALUATIONS] + counts[:, N_SCREENED]
    if not cost[free].sum() or not cost[~free].sum():
        return FIRST_SHARE if share == 0.0 else share
    if (counts[free, STAGE] > 0).mean() < least_acceptance:
        return 0.0  # rare long jumps, as into a mode, while the random walk is still on its way
    a = squared[free].sum() / cost[free].sum()
    b = squared[~free].sum() / cost[~free].sum()
    found = a**2 / (a**2 + b**2) if a > 0 else 0.0
    return min(found, MOST_SHARE) if found >= NO_SHARE else 0.0


def fitted_mixture(parts: Sequence[Array], rng: np.random.Generator) -> Array | None:
    """A packed mixture fitted to draws (n, d) of several chains.

    None if they are few, or do not vary in every direction.
    """
    most = max(MOST_FITTED, MOST_PER_DIMENSION * parts[0].shape[1])
    step = -(-sum(map(len, parts)) // most)
    parts = [part[::-step] for part in parts if len(part)]
    draws = np.concatenate(parts)
    dim = draws.shape[1]
    if len(np.unique(draws, axis=0)) < FEWEST * dim:
        return None
    found = standardised(draws)
    if found is None:
        return None
    whitened = np.split(found.z, np.cumsum([len(part) for part in parts])[:-1])
    mixture = _likeliest(whitened, rng).with_defensive_component()
    return _packed(mixture.affine(found.mean, found.chol))


def _likeliest(parts: Sequence[Array], rng: np.random.Generator) -> StudentMixture:
    """Fit the first halves of the parts with more and more components, compare on the second."""
    first = np.concatenate([part[: len(part) // 2] for part in parts])
    second = np.concatenate([part[len(part) // 2 :] for part in parts])
    numbers = range(1, MOST_COMPONENTS)
    best = likeliest_mixture(first, second, numbers, rng, least_gain=MIN_GAIN)
    return fit_mixture(np.concatenate(parts), best)


def _packed(mixture: StudentMixture) -> Array:
    n, dim = mixture.means.shape
    packed = no_mixture(dim)
    numbers, components = unpack_mixture(packed, dim)
    numbers[SHARE], numbers[N_COMPONENTS] = FIRST_SHARE, n
    components[:n, CUMULATIVE] = np.cumsum(mixture.weights)
    components[:n, LOG_FACTOR] = mixture.log_factors
    components[:n, MEAN : MEAN + dim] = mixture.means
    components[:n, MEAN + dim :] = mixture.chols.reshape(n, -1)
    return packed
