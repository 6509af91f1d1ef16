"""The log-densities and noise seeds that are stored with draws, compared with a model's."""

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..errors import DataMismatchError
from .density import ModelDensity

N_CHECKED = 16  # draws whose stored log-density is compared with a recomputed one
STORED_NAMES = ("lp", "logp")  # of the log-density in sample_stats, in PyMC and in nutpie
# Statistics of NUTS, and of steps that may move other variables after it.
_OF_NUTS, _OF_OTHERS = {"tree_depth", "tree_size"}, {"accepted", "accept", "nstep_in"}

Array = NDArray[np.float64]


def stats_of(idata: xr.DataTree) -> xr.Dataset:
    """The statistics of draws; empty if there are none."""
    return idata["sample_stats"].to_dataset() if "sample_stats" in idata.children else xr.Dataset()


def stored_name(stats: xr.Dataset) -> str | None:
    """Name of the joint log-density of the draws in `stats`, if there is one.

    Compound step methods store one column each, none of which is the joint log-density, and PyMC
    fills in zeros if the last of them stores none.
    """
    for name in STORED_NAMES:
        if name in stats and stats[name].ndim == 2 and stats[name].values.any():
            return name
    return None


def is_of_all_variables(stats: xr.Dataset) -> bool:
    """Whether the stored log-density is that of the draw, which no other step moved after it."""
    names = set(map(str, stats.data_vars))
    return not (names & _OF_NUTS and names & _OF_OTHERS)


def lacking_seeds(stats: xr.Dataset, density: ModelDensity) -> list[str]:
    """The noise seeds of the model that are not stored."""
    return [f"{name}_seed" for name in density.seed_names if f"{name}_seed" not in stats]


def stored_seeds(
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


def has_seeds_of_records(stats: xr.Dataset, density: ModelDensity) -> bool:
    """Whether the estimates of a draw have several seeds, which no one evaluation repeats."""
    names = [f"{name}_seed" for name in density.seed_names if f"{name}_seed" in stats]
    return any(
        (stats[name] != stats[name].isel({dim: 0})).any()
        for name in names
        for dim in set(stats[name].dims) - {"chain", "draw"}
    )


def compared(
    stats: xr.Dataset,
    name: str,
    density: ModelDensity,
    draws: Array,
    seeds: NDArray[np.int64],
    remedy: str = "",
) -> Array:
    """The stored log-densities (chain, draw), of which some are recomputed.

    Raises `DataMismatchError` if they disagree; ``remedy`` ends the message.
    """
    stored = stats[name].transpose("chain", "draw").values.astype(np.float64)
    if density.moved or has_seeds_of_records(stats, density):  # cannot be recomputed
        return stored
    flat_draws = draws.reshape(-1, draws.shape[-1])
    flat_seeds = seeds.reshape(len(flat_draws), -1)
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
        f"belong to another model, other data or other settings{remedy}"
    )
