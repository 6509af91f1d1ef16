"""Pictures over time of draws: one panel for each name, of a panel of records for each record."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from arviz_plots import PlotCollection

from .picture import Mark, picture, titles_of
from .results import SAMPLE_DIMS
from .shapes import band, bars, curve, interval, point_size, points

# Blue and orange are distinguishable with colour-vision deficiency; the truth is black.
DRAWS = {"color": "C0"}
DATA = {"color": "C1"}
TRUTH = {"color": "B1", "width": 0.9}
PROBABILITIES = (90, 50)
OPACITIES = {90: 0.2, 50: 0.4}  # of bands
WIDTHS = {90: 1.0, 50: 3.5}  # of bars
RECORDS_IN_LINE = 3
WIDE, NARROW, HEIGHT = 7.0, 3.6, 2.0  # inches of a panel, alone and beside others


def picture_over_time(
    panels: xr.Dataset,
    marks: Sequence[Mark],
    labels: Sequence[str],
    *,
    x: str,
    backend: str | None,
    pc_kwargs: Mapping[str, Any],
) -> PlotCollection:
    """Draw one panel per name, of which `labels` are told, and record, which is its title."""
    cols = [dim for dim in ("record", "state", "observable", "parameter") if dim in panels.dims]
    n_names, n_records = panels.sizes[cols[-1]], panels.sizes.get("record", 0)
    beside = n_names if n_names > 1 else RECORDS_IN_LINE
    in_line = min(beside, n_names * n_records) if n_records else 1
    return picture(
        panels,
        marks,
        x=x,
        y=panels[cols[-1]].copy(data=np.array(labels, dtype=object)),
        title=titles_of(panels, cols[:-1]),
        cols=cols,
        size=(WIDE if in_line == 1 else NARROW, HEIGHT),
        in_line=in_line,
        backend=backend,
        pc_kwargs=pc_kwargs,
    )


def over_draws(draws: xr.Dataset) -> xr.Dataset:
    """Return quantiles over the draws that are not NaN; NaN where all are."""
    known = draws.notnull().any(SAMPLE_DIMS)
    tails = [(1 - prob / 100) / 2 for prob in PROBABILITIES]
    levels = [*tails, 0.5, *(1 - tail for tail in tails[::-1])]
    return draws.where(known, 0.0).quantile(levels, SAMPLE_DIMS).where(known)


def connected(found: xr.Dataset) -> xr.Dataset:
    """Values of records without gaps at the times of other records."""
    return found.interpolate_na("time") if "record" in found.dims else found


def spread_of(quantiles: xr.Dataset, *, as_bars: bool = False) -> tuple[list[Mark], list[Mark]]:
    """Marks of 90 % and 50 % bands, and that of the median, which is above all others.

    Or of bars at separate times, without a median.
    """
    if as_bars:
        return [
            Mark(bars, f"bar_{prob}", ends, {**DRAWS, "width": WIDTHS[prob]}, f"{prob} %")
            for prob, ends in _ends(quantiles)
        ], []
    quantiles = connected(quantiles)
    bands = [
        Mark(band, f"band_{prob}", ends, {**DRAWS, "alpha": OPACITIES[prob]}, f"{prob} %")
        for prob, ends in _ends(quantiles)
    ]
    median = quantiles.sel(quantile=0.5, drop=True)
    return bands, [Mark(curve, "median", median, {**DRAWS, "width": 1.5}, "median")]


def points_of(values: xr.DataArray, name: str, style: Mapping[str, Any], key: str) -> Mark:
    """The mark of values over time as points."""
    return Mark(points, name, values.to_dataset(name=name), {**style, **point_size(values)}, key)


def _ends(quantiles: xr.Dataset) -> list[tuple[int, xr.Dataset]]:
    found = []
    for prob in PROBABILITIES:
        tail = (1 - prob / 100) / 2
        ends = (quantiles.sel(quantile=q, method="nearest", drop=True) for q in (tail, 1 - tail))
        found.append((prob, interval(*ends)))
    return found
