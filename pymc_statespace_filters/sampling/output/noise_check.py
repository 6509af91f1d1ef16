"""Whether an estimated likelihood is too noisy for its chains, asked before and after a run."""

from collections.abc import Callable, Sequence

import numpy as np
from pymc.stats.convergence import SamplerWarning

from pymc_statespace_filters.sampling.kernel.random_numbers import draw_seeds, side_generator
from pymc_statespace_filters.sampling.kernel.state import LOG_DENSITY, Draws
from pymc_statespace_filters.sampling.output.likelihood_variance import (
    SeedSpread,
    acceptance_share,
    spread_warning,
)
from pymc_statespace_filters.sampling.output.warnings import warning
from pymc_statespace_filters.sampling.target.target import Target

# Estimates at a point: enough to know their variance within a factor of two or three.
N_SEEDS = 12
# Iterations of a chain from which these estimates are 2 % of its evaluations at most.
LEAST_ITERATIONS = 600
# A start may lie in the tail, where estimates scatter more, and a chain leaves it for better ones.
# At this variance noise alone lets through one move in ten thousand: a warm-up ends before.
HOPELESS = 30.0
# After so many iterations without a single move it is said.
STILL = 100

Measure = Callable[[np.ndarray, np.ndarray], SeedSpread]


def is_worthwhile(target: Target, n_iterations: int) -> bool:
    """Whether to measure: each proposal has noise of its own, and the run is not a short one."""
    noisy = target.seed_names and target.settings.refresh_noise
    return bool(noisy) and n_iterations >= LEAST_ITERATIONS


def start_warning(spread: SeedSpread, chain: int) -> SamplerWarning | None:
    """Say that the noise at a start is such that a chain may not get away from it."""
    if not HOPELESS < spread.variance < np.inf:
        return None
    return warning(
        f"Chain {chain}, at the start: the estimated log-likelihood has a variance of "
        f"{spread.variance:.3g} over {spread.n} noise seeds. The noise lets through some "
        f"{acceptance_share(spread.variance):.1g} of the moves of an exact likelihood, so that the "
        "chain may never leave, and it has not yet. Start elsewhere (initvals), or give the filter "
        "more particles; psf.suggest_particles(model) finds the number."
    )


def at_the_highest_draw(
    draws: Sequence[Draws], tune: int, measure: Measure, keys: Sequence[np.ndarray]
) -> tuple[SeedSpread, SamplerWarning | None]:
    """Measure where the density of all chains' draws is highest.

    The estimate there came out high, but the place is good: what one meets near the centre.

    Parameters
    ----------
    draws : sequence of Draws
        Of each chain, whole.
    tune : int
        Iterations of warm-up, which are left out.
    measure : callable
        ``(position, seeds) -> SeedSpread``.
    keys : sequence of ndarray
        Of the chains' randomness.

    Returns
    -------
    SeedSpread
    SamplerWarning or None
        If the variance is far outside the range in which chains work best.
    """
    densities = [of_chain.numbers[tune:, LOG_DENSITY] for of_chain in draws]
    chain = int(np.argmax([of_chain.max() for of_chain in densities]))
    row = tune + int(densities[chain].argmax())
    shape = N_SEEDS, draws[chain].seeds.shape[1]
    # Of the chain's key, which a checkpoint holds: a resumed run measures the same.
    seeds = draw_seeds(side_generator(keys[chain]), shape)
    spread = measure(draws[chain].positions[row], seeds)
    message = spread_warning(spread, "at its highest draw", chain)
    return spread, None if message is None else warning(message)
