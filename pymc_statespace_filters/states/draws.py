"""Selected draws of a posterior with the noise seed of each."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..errors import ModelError
from ..pymc_model.posterior_draws import noise_was_moved, posterior_group
from ..system.checks import is_integer

SAMPLE_DIMS = ("chain", "draw")


@dataclass(frozen=True)
class PosteriorDraws:
    """Draws with the dimensions chain and draw, and their sampler statistics, which may be empty.

    ``noise_moved``: the chain moved its noise (``correlation``), so that no seed reproduces it.
    ``observed`` are the data, and ``filters`` the filters by variable, of the run; either may lack
    any of them.
    """

    posterior: xr.Dataset
    stats: xr.Dataset
    noise_moved: bool
    observed: xr.Dataset
    filters: Mapping[str, str]

    @property
    def shape(self) -> tuple[int, int]:
        """Number of chains and number of draws per chain."""
        return self.posterior.sizes["chain"], self.posterior.sizes["draw"]

    def values(self, name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """A free variable at every draw, (draws, *shape)."""
        if name not in self.posterior:
            raise ModelError(
                f"idata has no draws of {name!r}, on which the variable depends, got a posterior "
                f"with {sorted(map(str, self.posterior.data_vars))}"
            )
        values = self.posterior[name].transpose(*SAMPLE_DIMS, ...).values
        if values.shape[2:] != shape:
            raise ModelError(
                f"{name!r} has shape {shape} in the model, {values.shape[2:]} in idata"
            )
        values = values.reshape(-1, *shape)
        if bad := int((~np.isfinite(values.reshape(len(values), -1)).all(axis=1)).sum()):
            raise ModelError(
                f"{name!r} in idata must be finite, got {bad} of {len(values)} draws with NaN or "
                "infinity"
            )
        return values

    def stored_seeds(self, name: str, n_records: int) -> NDArray[np.int64] | None:
        """The noise seed of the likelihood estimate of every draw; None if none is stored.

        (draws,), or (draws, G) where each of the records of a panel keeps its own.
        """
        stored = f"{name}_seed"
        if self.noise_moved or stored not in self.stats:
            return None
        array = self.stats[stored]
        if not set(SAMPLE_DIMS) <= set(array.dims):
            raise ModelError(
                f"{stored} in sample_stats of idata must have the dimensions chain and draw, got "
                f"{array.dims}: drop sample_stats from idata"
            )
        with np.errstate(invalid="ignore"):  # what is not a number is refused
            values = array.transpose(*SAMPLE_DIMS, ...).values
            seeds = values.astype(np.int64) if values.dtype.kind in "iuf" else np.array(-1)
        if bad := int(np.sum((seeds < 0) | (seeds != values))):
            raise ModelError(
                f"{stored} in sample_stats of idata must be noise seeds, integers from 0 to "
                f"2^63 - 1, got others in {bad} of {values.size} places, as where runs of different"
                " models are put together: use the draws of one run, or drop sample_stats from "
                "idata"
            )
        if seeds.ndim > 2 and seeds.shape[2] != n_records:
            raise ModelError(
                f"idata has noise seeds of {seeds.shape[2]} records of {name!r}, of which the model"
                f" has {n_records}: use the model of these draws, or drop sample_stats from idata"
            )
        return seeds.reshape(-1, *seeds.shape[2:])

    def dataset(self, variables: dict[str, tuple], coords: dict[str, Any]) -> xr.Dataset:
        """Reshape arrays (draws, ...) to (chain, draw, ...), given their further dimensions."""
        arrays = {
            name: ((*SAMPLE_DIMS, *dims), values.reshape(*self.shape, *values.shape[1:]))
            for name, (dims, values) in variables.items()
        }
        of_draws = {dim: self.posterior[dim].values for dim in SAMPLE_DIMS}
        return xr.Dataset(arrays, coords={**of_draws, **coords})


def select_draws(idata: xr.DataTree, n_draws: int | None) -> PosteriorDraws:
    """Select all draws, or about `n_draws` of them, evenly from every chain."""
    posterior = posterior_group(idata).transpose(*SAMPLE_DIMS, ...)
    stats = idata["sample_stats"].to_dataset() if "sample_stats" in idata.children else xr.Dataset()
    n_chains, length = posterior.sizes["chain"], posterior.sizes["draw"]
    if not n_chains * length:
        raise ModelError("idata must have draws in its posterior, got none")
    stats = _matching_stats(stats, posterior)
    if n_draws is not None:
        if not is_integer(n_draws) or not 1 <= n_draws <= n_chains * length:
            raise ModelError(
                f"n_draws must be an integer from 1 to {n_chains * length}, the number of draws, "
                f"or None for all of them, got {n_draws!r}"
            )
        each = max(1, n_draws // n_chains)
        kept = {"draw": np.linspace(0, length - 1, each).round().astype(int)}
        posterior, stats = posterior.isel(kept), stats.isel(kept, missing_dims="ignore")
    data = idata["observed_data"].to_dataset() if "observed_data" in idata.children else None
    return PosteriorDraws(
        posterior,
        stats,
        noise_was_moved(idata),
        xr.Dataset() if data is None else data,
        json.loads(idata.attrs.get("filter", "{}")),
    )


def _matching_stats(stats: xr.Dataset, posterior: xr.Dataset) -> xr.Dataset:
    """The statistics of the draws of `posterior`, which may be a selection of all draws."""
    labels = {dim: posterior[dim].values for dim in SAMPLE_DIMS}
    if not set(SAMPLE_DIMS) <= set(stats.dims):
        return xr.Dataset()
    if not all(np.isin(values, stats[dim]).all() for dim, values in labels.items()):
        raise ModelError(
            "the draws of the posterior are not among those of sample_stats, so that their noise "
            "seeds are unknown: make the same selection in all groups, or drop sample_stats"
        )
    return stats.sel(labels)
