"""Whether chains will hardly move because of noise, and which filter would do: before they begin.

A run takes minutes until it shows that its chains do not move. The noise of the likelihood is
therefore measured where the search for starts has ended. If it is too strong, so is the noise of
another filter of the same posterior, which takes seconds to compile.
"""

import time

import numpy as np
from pymc.model import Model
from pymc.stats.convergence import SamplerWarning

from ...filters.protocol import Filter, properties
from ...filters.recommendation import short_form
from ...pymc_model.inspection import noisy_filters, quieter_filter
from ..kernel.state import draw_seeds
from ..output.likelihood_variance import (
    N_SEEDS,
    ROUNDING,
    TARGET,
    TOO_NOISY,
    SeedSpread,
    acceptance_share,
    more_particles,
    rounded,
    seed_spread,
)
from ..output.warnings import sampler_warning
from ..starts.modes import Points
from ..target.log_density import LogDensity
from ..target.target import Target


def noise_warning(
    model: Model, target: Target, found: Points, rng: np.random.Generator
) -> SamplerWarning | None:
    """Warn of too much noise at a typical one of the points found, and say what was seen to do."""
    typical = found.x[np.argsort(found.log_density)[len(found.x) // 2]]
    spread, seconds = _measured(target.density, target, typical, rng)
    # One low estimate of many makes the variance large, but hardly a chain slow.
    if not (spread.variance > TOO_NOISY and spread.variance_low > TARGET[1]):
        return None
    remedy = more_particles(spread.variance, target.collapse_remedy)
    if (filters := _quieter(model)) is not None:
        other, longer = _measured(target.density_with(filters), target, typical, rng)
        if other.variance < TARGET[1]:
            names = " and ".join(dict.fromkeys(map(short_form, filters.values())))
            less = f"{other.variance:.1g}" if other.variance > ROUNDING else "zero"
            remedy = (
                f"With {names} the variance is {less} there, and an evaluation takes "
                f"{rounded(longer / seconds)} times as long: give the model this filter."
            )
    return sampler_warning(
        "At a typical one of the starts the estimated log-likelihood has a variance of "
        f"{spread.variance:.3g} over {spread.n} noise seeds. Chains accept about "
        f"{acceptance_share(spread.variance):.1g} of the moves that they would accept with an "
        f"exact likelihood. {remedy}"
    )


def _measured(
    density: LogDensity, target: Target, x: np.ndarray, rng: np.random.Generator
) -> tuple[SeedSpread, float]:
    """The spread of the estimates at a point, and the CPU seconds of one."""
    bound, seeds = density.bind(), draw_seeds(rng, (N_SEEDS, len(target.seed_names)))
    bound(x, (), seeds[0])  # loads the machine code
    began = time.process_time()
    spread = seed_spread(bound, x, (), seeds)
    return spread, (time.process_time() - began) / N_SEEDS


def _quieter(model: Model) -> dict[str, Filter] | None:
    """Filters with little noise and the same posterior; None if a variable has none."""
    found = {}
    for name, filter in noisy_filters(model).items():
        other = quieter_filter(model, name) if properties(filter).unbiased else None
        if other is None:
            return None
        found[name] = other
    return found
