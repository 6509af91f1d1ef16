"""The search for what chains have missed, at the end of their run, in a small part of its time."""

import numpy as np
from pymc.model import Model
from pymc.stats.convergence import SamplerWarning
from xarray import DataTree

from ...pymc_model.density import ModelDensity
from ...pymc_model.posterior_draws import noise_was_moved, unconstrained_draws
from ..target.initial_points import PriorDraws
from .signs import signs_message
from .warnings import sampler_warning

# CPU seconds: so many, or this share of the time of the run if that is more.
_LEAST_SECONDS, _SHARE = 1.0, 0.1
# Fewer draws in all know too little of their tails.
_LEAST_DRAWS = 4000


def unvisited_warnings(
    tree: DataTree, model: Model, prior: PriorDraws, seconds: float, rng: np.random.Generator
) -> list[SamplerWarning]:
    """Warn of modes and tails of the posterior that the chains of a run of so many seconds lack.

    The outcome is stored with the draws. Chains that held one noise seed are not checked.
    """
    # They load SciPy's statistics, which would take a third of the time to import a sampler.
    from ...unvisited.check import MOST_PARAMETERS
    from ...unvisited.sentences import store, unvisited

    posterior = tree["posterior"]
    if posterior.sizes["chain"] * posterior.sizes["draw"] < _LEAST_DRAWS:
        return []
    stats = tree["sample_stats"]
    seeded = [name for name in stats.data_vars if str(name).endswith("_seed")]
    if "lp" not in stats or (seeded and not tree.attrs["refresh_noise"]):
        return []
    draws = unconstrained_draws(tree, model)
    if draws.shape[-1] > MOST_PARAMETERS:
        return []
    density = ModelDensity(model, moved=noise_was_moved(tree))

    def evaluate(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        size = len(x), len(density.seed_names)
        return density.evaluate(x, rng.integers(np.iinfo(np.int64).max, size=size))

    log_density = stats["lp"].transpose("chain", "draw").values.astype(np.float64)
    seconds = max(_LEAST_SECONDS, _SHARE * seconds)
    wide = prior.draws if prior.is_prior and len(prior.draws) > 1 else None
    found = unvisited(model, draws, log_density, evaluate, seconds, rng, wide)
    store(tree, found)
    if not density.seed_names:
        flat = draws.reshape(-1, draws.shape[-1])
        sign = signs_message(model, flat, lambda x: evaluate(x, rng))
        found = found if sign is None else [sign, *found]
    return [sampler_warning(f"{text[0].upper()}{text[1:]}.") for text in found]
