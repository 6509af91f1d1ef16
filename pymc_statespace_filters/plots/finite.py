"""States that take a few values, as regimes: ribbons as thick as the probability of a value."""

from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection

from .canvas import BOUND, band, interval, label_ticks
from .marks import DRAWS
from .results import SAMPLE_DIMS

MOST_VALUES, LEAST_DRAWS = 8, 10  # a value of a continuous state is drawn once
SHARE = 0.9  # of the gap between two values that a ribbon of probability one fills
STYLE = {**DRAWS, "alpha": 0.5}


def ribbons(draws: xr.DataArray) -> xr.Dataset | None:
    """Lower and upper edges of the ribbons, (state, value, bound, time); NaN for other states.

    None if no state takes a few values.
    """
    found = {str(name): _edges(draws.sel(state=name, drop=True)) for name in draws["state"].values}
    known = {name: edges for name, edges in found.items() if edges is not None}
    if not known:
        return None
    names = xr.DataArray(list(known), dims="state", name="state")
    joined = xr.concat(list(known.values()), names, join="outer")
    return joined.reindex(state=list(found)).to_dataset(name="states")


def is_continuous(edges: xr.Dataset) -> xr.DataArray:
    """Whether a state has no ribbons, (state,)."""
    return edges["states"].isnull().all(["value", BOUND, "time"])


def draw_ribbons(collection: PlotCollection, edges: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Draw the ribbons over time; return their legend entry."""
    collection.map(_bands, "probability", data=edges, **STYLE)
    collection.map(_tick_values, data=edges, ignore_aes="all", store_artist=False)
    return {"probability": {**STYLE, "width": 8}}


def _edges(draws: xr.DataArray) -> xr.DataArray | None:
    """Edges of the ribbons of one state; None if it takes more than a few values."""
    known = draws.notnull()
    values = np.unique(draws.values[known.values])
    if not 2 <= values.size <= MOST_VALUES or known.sum() < LEAST_DRAWS * values.size:
        return None
    centre = xr.DataArray(values, dims="value")
    probability = (draws == centre).sum(SAMPLE_DIMS) / known.sum(SAMPLE_DIMS)
    half = 0.5 * SHARE * np.diff(values).min() * probability.where(probability > 0.0)
    edges = interval((centre - half).to_dataset(name="e"), (centre + half).to_dataset(name="e"))
    return edges["e"].assign_coords(value=np.arange(values.size))


def _bands(da: xr.DataArray, target: Any, **kwargs: Any) -> Any:
    """Fill the ribbons of all values; return the last one."""
    drawn = None
    for value in da["value"].values:
        drawn = band(da.sel(value=value, drop=True), target, **kwargs) or drawn
    return drawn


def _tick_values(da: xr.DataArray, target: Any) -> None:
    """Set the ticks of a state with ribbons at its values."""
    values = da.mean(BOUND).median("time").dropna("value").values  # zero stays zero
    if values.size:
        label_ticks(da, target, ticks={"values": values, "labels": [f"{v:g}" for v in values]})
