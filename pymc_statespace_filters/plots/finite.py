"""States that take a few values, as regimes: ribbons as thick as the probability of a value."""

from typing import Any

import numpy as np
import xarray as xr

from .results import SAMPLE_DIMS, names_of
from .shapes import BOUND, interval, y_ticks

MOST_VALUES, LEAST_DRAWS = 8, 10  # a value of a continuous state is drawn once
SHARE = 0.9  # of the gap between two values that a ribbon of probability one fills


def ribbons(draws: xr.DataArray) -> xr.DataArray | None:
    """Lower and upper edges of the ribbons along "value", of the states that take a few values."""
    edges = {name: _edges(draws.sel(state=name, drop=True)) for name in names_of(draws, "state")}
    known = {name: found for name, found in edges.items() if found is not None}
    if not known:
        return None
    states = xr.DataArray(list(known), dims="state", name="state")
    return xr.concat(list(known.values()), states, join="outer")


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


def tick_values(da: xr.DataArray, target: Any) -> None:
    """Set the ticks of a state with ribbons at its values."""
    values = da.mean(BOUND).median("time").dropna("value").values  # zero stays zero
    y_ticks(da, target, values=values, labels=[f"{value:g}" for value in values])
