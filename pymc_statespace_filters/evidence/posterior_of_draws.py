"""The posterior of a DataTree: its draws, and the log-densities and noise seeds beside them."""

from functools import partial

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..errors import DataMismatchError, ModelError
from ..pymc_model.density import ModelDensity
from ..pymc_model.filter_estimates import failures_at
from ..pymc_model.posterior_draws import check_one_model, populations_of, unconstrained_draws
from ..pymc_model.prior import ModelPrior
from .posterior import Posterior

N_CHECKED = 16  # draws whose stored log-density is compared with a recomputed one
STORED_NAMES = ("lp", "logp")  # of the log-density in sample_stats, in PyMC and in nutpie

Array = NDArray[np.float64]


def build_posterior(idata: xr.DataTree, density: ModelDensity) -> tuple[Posterior, str]:
    """Combine the draws of `idata` with the compiled density of their model.

    ``sample_stats`` may have the log-density ``lp`` of each draw; it must have it, or the noise
    seeds ``<name>_seed``, if the noise was refreshed along the chain. Also returns the treatment of
    the noise: "none", "refreshed" or "held", as in `Evidence`.

    Raises
    ------
    ModelError, DataMismatchError
        As `check_one_model` and `unconstrained_draws`; and if stored and recomputed log-densities
        disagree.
    """
    check_one_model(idata, density.model)
    draws = unconstrained_draws(idata, density.model)
    stats = idata["sample_stats"].to_dataset() if "sample_stats" in idata.children else xr.Dataset()
    lacking = [f"{name}_seed" for name in density.seed_names if f"{name}_seed" not in stats]
    stored = _stored_name(stats)
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
    seeds = _stored_seeds(stats, density, draws.shape[:2])
    log_density = _stored_log_density(stats, density, draws, seeds)

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
        size = (len(x), seeds.shape[-1])
        return density.evaluate(x, rng.integers(np.iinfo(np.int64).max, size=size))

    prior = ModelPrior(density.model)
    failures = partial(failures_at, density.model)
    facts = not held, prior, failures, populations_of(idata)
    return Posterior(draws, log_density, evaluate, *facts), noise


def reproducing_seeds(idata: xr.DataTree, density: ModelDensity) -> NDArray[np.int64] | None:
    """Seeds (chain, draw, n_seeds) that reproduce the estimates of the draws; None if none do."""
    stats = idata["sample_stats"].to_dataset() if "sample_stats" in idata.children else xr.Dataset()
    lacking = any(f"{name}_seed" not in stats for name in density.seed_names)
    if lacking or density.moved or _has_seeds_of_records(stats, density):
        return None
    posterior = idata["posterior"]
    shape = posterior.sizes["chain"], posterior.sizes["draw"]
    return _stored_seeds(stats, density, shape)


def _stored_seeds(
    stats: xr.Dataset, density: ModelDensity, shape: tuple[int, int]
) -> NDArray[np.int64]:
    """Noise seeds of the draws, (chain, draw, n_seeds); the model's where none are stored."""
    columns = [
        _one_seed(stats[f"{name}_seed"].transpose("chain", "draw", ...).values)
        if f"{name}_seed" in stats
        else np.full(shape, seed)
        for name, seed in zip(density.seed_names, density.model_seeds, strict=True)
    ]
    return (
        np.stack(columns, axis=-1).astype(np.int64) if columns else np.empty((*shape, 0), np.int64)
    )


def _one_seed(seeds: NDArray[np.int64]) -> NDArray[np.int64]:
    """The seed of each draw, (chain, draw).

    The records of a panel that were moved one by one have seeds of their own. Where these differ
    the result is their sum, which tells whether any has changed.
    """
    if seeds.ndim == 2:
        return seeds
    is_one = (seeds == seeds[..., :1]).all(axis=-1)
    return np.where(is_one, seeds[..., 0], seeds.sum(axis=-1))


def _has_seeds_of_records(stats: xr.Dataset, density: ModelDensity) -> bool:
    """Whether the estimates of a draw have several seeds, which no one evaluation repeats."""
    names = [f"{name}_seed" for name in density.seed_names if f"{name}_seed" in stats]
    return any(
        (stats[name] != stats[name].isel({dim: 0})).any()
        for name in names
        for dim in set(stats[name].dims) - {"chain", "draw"}
    )


def _stored_name(stats: xr.Dataset) -> str | None:
    """Name of the joint log-density of the draws in `stats`, if there is one.

    Compound step methods store one column each, none of which is the joint log-density, and PyMC
    fills in zeros if the last of them stores none.
    """
    for name in STORED_NAMES:
        if name in stats and stats[name].ndim == 2 and stats[name].values.any():
            return name
    return None


def _stored_log_density(
    stats: xr.Dataset, density: ModelDensity, draws: Array, seeds: NDArray[np.int64]
) -> Array:
    """Log-densities of the draws (chain, draw): the stored ones, else recomputed."""
    flat_draws = draws.reshape(-1, draws.shape[-1])
    flat_seeds = seeds.reshape(len(flat_draws), -1)
    name = _stored_name(stats)
    if name is None:
        log_density = density.evaluate(flat_draws, flat_seeds)
        if impossible := int(np.isneginf(log_density).sum()):
            raise DataMismatchError(
                f"{impossible} of {len(flat_draws)} draws of idata have zero density under the "
                "model: they belong to another model or to other data"
            )
        return log_density.reshape(draws.shape[:2])

    stored = stats[name].transpose("chain", "draw").values.astype(np.float64)
    if density.moved or _has_seeds_of_records(stats, density):  # cannot be recomputed
        return stored
    checked = np.linspace(0, len(flat_draws) - 1, N_CHECKED).astype(int)
    recomputed = density.evaluate(flat_draws[checked], flat_seeds[checked])
    expected = stored.ravel()[checked]
    # The transform loses digits near a bound, so that a minority of the draws may differ.
    # PyMC 6.4 stores NumPyro's potential energy, which has the opposite sign, under the same name.
    agree = {
        sign: np.isclose(recomputed, sign * expected, rtol=1e-6, atol=1e-4) for sign in (1.0, -1.0)
    }
    for sign, agrees in agree.items():
        if agrees.mean() >= 0.5:
            return sign * stored
    worst = int(np.flatnonzero(~agree[1.0])[0])
    raise DataMismatchError(
        f"sample_stats[{name!r}] of idata must be the model's log-density, got "
        f"{expected[worst]:.6g} where the model gives {recomputed[worst]:.6g}: the draws "
        "belong to another model, other data or other settings"
    )
