"""Modes of the marginal posterior densities (thesis, Tables 4, 9 and 14)."""

from collections.abc import Hashable, Iterable, Mapping

import numpy as np
import pandas as pd
import xarray as xr
from arviz_base.labels import BaseLabeller
from arviz_base.sel_utils import xarray_sel_iter
from arviz_stats import ess, kde
from numpy.typing import NDArray

from pymc_statespace_filters.errors import ModelError

MIN_INDEPENDENT = 100  # draws for a bandwidth

Array = NDArray[np.float64]


def marginal_modes(
    idatas: xr.DataTree | Mapping[str, xr.DataTree], *, var_names: str | Iterable[str] | None = None
) -> pd.DataFrame:
    """Find the mode of each marginal posterior density, one row per model.

    These are the "MAP of the marginal distribution" of the thesis. They differ from the mode of the
    joint density, and depend on the scale on which a parameter is expressed.

    Parameters
    ----------
    idatas : mapping of str to xarray.DataTree, or xarray.DataTree
        Posterior draws of each model; continuous variables.
    var_names : str or iterable of str, optional
        Variables to include, where a model has them; all of the posterior by default.

    Returns
    -------
    pandas.DataFrame
        Index ``model`` (``posterior`` for a single DataTree), one column per scalar, labelled as
        by ArviZ: ``theta[0]``. NaN if a model lacks the parameter or a draw is not finite.

    Raises
    ------
    ModelError
        If there is no group ``posterior``, or no model has one of `var_names`.

    Notes
    -----
    The density is ArviZ's kernel estimate, mirrored at the smallest and the largest draw, with
    ArviZ's bandwidth for the effective number of draws: the repeated values of rejecting chains
    would otherwise give too small a bandwidth. With 1000 effective draws the standard error of a
    mode is about 15 per cent of a standard deviation; a mode at the end of a support, such as that
    of a scale that may be zero, is only found to be near it.
    """
    models = {"posterior": idatas} if isinstance(idatas, xr.DataTree) else idatas
    if not isinstance(models, Mapping) or not models:
        raise ModelError(
            "idatas must be a DataTree or a mapping of model names to DataTree with at least one "
            f"entry, got {idatas!r}"
        )
    posteriors = {name: _posterior(name, idata) for name, idata in models.items()}
    names = [var_names] if isinstance(var_names, str) else list(var_names or [])
    known = dict.fromkeys(name for posterior in posteriors.values() for name in posterior.data_vars)
    if unknown := [name for name in names if name not in known]:
        raise ModelError(
            f"var_names must be among {list(known)}, the variables of the posteriors, got {unknown}"
        )
    rows = [_modes(posterior, names or known) for posterior in posteriors.values()]
    return pd.DataFrame(rows, index=pd.Index(posteriors, name="model"))


def _posterior(name: str, idata: xr.DataTree) -> xr.Dataset:
    if not isinstance(idata, xr.DataTree) or "posterior" not in idata.children:
        raise ModelError(
            f"idatas[{name!r}] must be a DataTree with a group 'posterior', got {idata!r}"
        )
    return idata["posterior"].to_dataset()


def _modes(posterior: xr.Dataset, names: Iterable[Hashable]) -> dict[str, float]:
    """Mode of every scalar, by its label."""
    found = {}
    for name, sel, isel in xarray_sel_iter(posterior[[n for n in names if n in posterior]]):
        draws = posterior[name].isel(isel).transpose("chain", "draw").values.astype(np.float64)
        found[BaseLabeller().make_label_flat(name, sel, isel)] = _mode(draws)
    return found


def _mode(draws: Array) -> float:
    """Mode of draws (chain, draw)."""
    if not np.isfinite(draws).all():
        return np.nan
    if np.ptp(draws) == 0:
        return float(draws.flat[0])
    # Bandwidth rules assume independent draws.
    n_eff = max(MIN_INDEPENDENT, float(ess(draws))) if draws.size > MIN_INDEPENDENT else np.inf
    with np.errstate(divide="ignore"):  # a flat density has no curvature
        _, _, bandwidth = kde(draws.ravel()[:: max(1, int(draws.size // n_eff))])
    grid, density, _ = kde(draws.ravel(), bw=float(bandwidth))
    return float(grid[np.argmax(density)])
