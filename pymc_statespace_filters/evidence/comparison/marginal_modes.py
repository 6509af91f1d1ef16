"""The most probable value of each parameter by itself (thesis, Tables 4, 9 and 14)."""

from collections.abc import Hashable, Iterable, Mapping

import arviz as az
import numpy as np
import pandas as pd
import xarray as xr
from arviz_base.labels import BaseLabeller
from arviz_base.sel_utils import xarray_sel_iter
from numpy.typing import NDArray

from pymc_statespace_filters.errors import ModelError

MIN_INDEPENDENT = 100  # of fewer draws even a bandwidth is a guess

Array = NDArray[np.float64]


def marginal_modes(
    idatas: xr.DataTree | Mapping[str, xr.DataTree], *, var_names: str | Iterable[str] | None = None
) -> pd.DataFrame:
    """Find the mode of each marginal posterior density, one row for a model.

    These are the "MAP of the marginal distribution" of the thesis. They differ from the mode of the
    joint density, and unlike it they move with a nonlinear change of a parameter's scale.

    Parameters
    ----------
    idatas : mapping of str to xarray.DataTree, or xarray.DataTree
        Posterior draws of each model; continuous variables.
    var_names : str or iterable of str, optional
        Variables to include, where a model has them; all of the posterior by default.

    Returns
    -------
    pandas.DataFrame
        Index ``model`` (of a lone DataTree: ``posterior``), a column for each scalar, labelled as
        by ArviZ: ``theta[0]``. NaN where a model lacks the parameter, or a draw is not finite.

    Raises
    ------
    ModelError
        If there is no group ``posterior``, or nobody has one of `var_names`.

    Notes
    -----
    The density is ArviZ's kernel estimate, mirrored at the smallest and the largest draw, with the
    bandwidth that ArviZ finds for as many draws as are independent: chains that reject, and so
    repeat themselves, would otherwise get too small a one. From draws worth 1000 independent ones
    a mode is known to some 15 per cent of a standard deviation; near the end of a support, as of a
    scale that may be zero, this says that it is near and no more.

    Examples
    --------
    >>> import arviz as az
    >>> import numpy as np
    >>> import pymc_statespace_filters as psf
    >>> rng = np.random.default_rng(1)
    >>> linear = az.from_dict({"posterior": {"alpha": rng.normal(4, 0.1, (4, 1000))}})
    >>> draws = {"alpha": rng.gamma(3, 1, (4, 1000)), "beta": rng.normal(-4, 1, (4, 1000))}
    >>> cubic = az.from_dict({"posterior": draws})
    >>> psf.marginal_modes({"linear": linear, "cubic": cubic}).round(0)
            alpha  beta
    model
    linear    4.0   NaN
    cubic     2.0  -4.0
    """
    models = {"posterior": idatas} if isinstance(idatas, xr.DataTree) else idatas
    if not isinstance(models, Mapping) or not models:
        raise ModelError(
            "idatas must be a DataTree or a mapping of model names to DataTree with at least one "
            f"entry, got {idatas!r}"
        )
    posteriors = {name: _posterior(name, idata) for name, idata in models.items()}
    names = [var_names] if isinstance(var_names, str) else list(var_names or [])
    held = dict.fromkeys(name for posterior in posteriors.values() for name in posterior.data_vars)
    if unknown := [name for name in names if name not in held]:
        raise ModelError(
            f"var_names has {unknown}, which no posterior holds; they hold {list(held)}"
        )
    rows = [_modes(posterior, names or held) for posterior in posteriors.values()]
    return pd.DataFrame(rows, index=pd.Index(posteriors, name="model"))


def _posterior(name: str, idata: xr.DataTree) -> xr.Dataset:
    if not isinstance(idata, xr.DataTree) or "posterior" not in idata.children:
        raise ModelError(f"idatas[{name!r}] must be a DataTree with a group 'posterior'")
    return idata["posterior"].to_dataset()


def _modes(posterior: xr.Dataset, names: Iterable[Hashable]) -> dict[str, float]:
    """Mode of every scalar, by its label."""
    found = {}
    for name, sel, isel in xarray_sel_iter(posterior[[n for n in names if n in posterior]]):
        draws = posterior[name].isel(isel).transpose("chain", "draw").values.astype(np.float64)
        found[BaseLabeller().make_label_flat(name, sel, isel)] = _mode(draws)
    return found


def _mode(draws: Array) -> float:
    """Place of the highest density of draws (chain, draw)."""
    if not np.isfinite(draws).all():
        return np.nan
    if np.ptp(draws) == 0:
        return float(draws.flat[0])
    # Rules for the bandwidth take every draw for an independent one.
    worth = max(MIN_INDEPENDENT, float(az.ess(draws))) if draws.size > MIN_INDEPENDENT else np.inf
    with np.errstate(divide="ignore"):  # a flat density has no curvature to go by
        _, _, bandwidth = az.kde(draws.ravel()[:: max(1, int(draws.size // worth))])
    grid, density, _ = az.kde(draws.ravel(), bw=float(bandwidth))
    return float(grid[np.argmax(density)])
