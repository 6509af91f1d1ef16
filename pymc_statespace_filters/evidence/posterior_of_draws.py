"""The posterior of a DataTree: its draws, and the log-densities and noise seeds beside them."""

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..errors import DataMismatchError, ModelError
from ..pymc_model.density import ModelDensity
from ..pymc_model.posterior_draws import check_one_model, populations_of, unconstrained_draws
from ..pymc_model.prior import ModelPrior
from ..pymc_model.stored_density import (
    compared,
    has_seeds_of_records,
    lacking_seeds,
    stats_of,
    stored_name,
    stored_seeds,
)
from .posterior import Posterior

Array = NDArray[np.float64]


def build_posterior(idata: xr.DataTree, density: ModelDensity) -> tuple[Posterior, str]:
    """Combine the draws of `idata` with the compiled density of their model.

    ``sample_stats`` may have the log-density ``lp`` of each draw; it must have it, or the noise
    seeds ``<name>_seed``, if the noise was refreshed along the chain. Also returns the treatment of
    the noise: "none", "refreshed" or "held", as in `Evidence`. Raises as `check_one_model` and
    `unconstrained_draws`, and `DataMismatchError` if stored and recomputed log-densities disagree.
    """
    check_one_model(idata, density.model)
    draws = unconstrained_draws(idata, density.model)
    stats = stats_of(idata)
    lacking = lacking_seeds(stats, density)
    stored = stored_name(stats)
    if density.moved and stored is None:
        raise DataMismatchError(
            "sample_stats of idata must hold the log-density of the draws, because the chain moved "
            "its noise (correlation) and no seed reproduces it: sample all variables by one DRAM "
            "step, and keep the group sample_stats"
        )
    if lacking and stored is None:
        raise DataMismatchError(
            f"sample_stats of idata must hold the noise seeds of the draws ({lacking}) or their "
            "log-density, to recover the likelihood estimates of the chain: keep the group "
            "sample_stats that DRAM stores"
        )
    seeds = stored_seeds(stats, density, draws.shape[:2])
    log_density = _log_density(stats, density, draws, seeds)

    held = not density.moved and bool((seeds == seeds[:1, :1]).all())
    if not (held or density.moved) and (seeds == seeds[:, :1]).all():
        raise ModelError(
            "idata must hold chains of one noise seed if the seed was held, got "
            f"{len(np.unique(seeds[:, 0], axis=0))} seeds in {len(seeds)} chains: pass one chain "
            "at a time"
        )
    noise = "none" if not density.seed_names else "held" if held else "refreshed"

    def evaluate(x: Array, rng: np.random.Generator) -> Array:
        if held:
            return density.evaluate(x, np.broadcast_to(seeds[0, 0], (len(x), seeds.shape[-1])))
        return density.evaluate_afresh(x, rng)

    prior = ModelPrior(density.model)
    facts = not held, prior, populations_of(idata)
    return Posterior(draws, log_density, evaluate, *facts), noise


def reproducing_seeds(idata: xr.DataTree, density: ModelDensity) -> NDArray[np.int64] | None:
    """Seeds (chain, draw, n_seeds) that reproduce the estimates of the draws; None if none do."""
    stats = stats_of(idata)
    if lacking_seeds(stats, density) or density.moved or has_seeds_of_records(stats, density):
        return None
    posterior = idata["posterior"]
    shape = posterior.sizes["chain"], posterior.sizes["draw"]
    return stored_seeds(stats, density, shape)


def _log_density(
    stats: xr.Dataset, density: ModelDensity, draws: Array, seeds: NDArray[np.int64]
) -> Array:
    """Log-densities of the draws (chain, draw): the stored ones, else recomputed."""
    if (name := stored_name(stats)) is not None:
        return compared(stats, name, density, draws, seeds)
    flat_draws = draws.reshape(-1, draws.shape[-1])
    log_density = density.evaluate(flat_draws, seeds.reshape(len(flat_draws), -1))
    if impossible := int(np.isneginf(log_density).sum()):
        raise DataMismatchError(
            f"{impossible} of {len(flat_draws)} draws of idata have zero density under the "
            "model: they belong to another model or to other data"
        )
    return log_density.reshape(draws.shape[:2])
