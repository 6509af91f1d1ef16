"""What a DataTree of posterior draws must hold, whoever made it."""

import xarray as xr

from pymc_statespace_filters.errors import ModelError


def posterior_group(idata: xr.DataTree) -> xr.Dataset:
    """The draws, every variable with the dimensions chain and draw.

    Raises
    ------
    ModelError
        If `idata` is no DataTree, or has no such group.
    """
    if not isinstance(idata, xr.DataTree):
        raise ModelError(
            "idata must be a DataTree of posterior draws, as pm.sample and sample_dram return it, "
            f"got {type(idata).__name__}"
        )
    if "posterior" not in idata.children:
        raise ModelError(f"idata must have a group 'posterior', it has {sorted(idata.children)}")
    posterior = idata["posterior"].to_dataset()
    if not {"chain", "draw"} <= set(posterior.dims):
        raise ModelError(
            "the posterior of idata must have the dimensions chain and draw, it has "
            f"{sorted(map(str, posterior.dims))}: select one chain as isel(chain=[0])"
        )
    return posterior


def noise_was_moved(idata: xr.DataTree) -> bool:
    """Whether a chain moved the noise of its estimates, so that no seed gives them again."""
    return "sample_stats" in idata.children and "correlation" in idata["sample_stats"]
