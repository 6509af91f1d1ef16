"""The figures of the validation: evidences and model probabilities against the measurements."""

import matplotlib.pyplot as plt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import softmax

BAND = (0.1, 0.9)


def plot_evidences(flat: xr.DataArray, corrected: xr.DataArray) -> Figure:
    """Plot ln evidence against J, and its difference from M1's, which is hard to see (Fig. 10)."""
    figure, panels = plt.subplots(
        2, 2, figsize=(9, 6), layout="constrained", sharex=True, sharey="row"
    )
    titles = ("flat priors", "flat priors, with the correction $J^{-1.5 k}$")
    for column, title, found in zip(panels.T, titles, (flat, corrected), strict=True):
        _medians_and_bands(column[0], found)
        _medians_and_bands(column[1], found - found.sel(model="M1"))
        column[0].set_title(title)
        column[1].set_xlabel("number of measurements J")
    panels[0, 0].set_ylabel("ln evidence")
    panels[1, 0].set_ylabel("ln evidence, less that of M1")
    panels[0, 0].legend(frameon=False)
    return figure


def plot_probabilities(designs: dict[str, tuple[xr.DataArray, xr.DataArray]]) -> Figure:
    """Plot model probabilities without and with correction, one row for each measurement design."""
    figure, panels = plt.subplots(
        len(designs), 2, figsize=(9, 6), layout="constrained", sharex=True, sharey=True
    )
    titles = ("flat priors", "with the correction")
    for row, (name, evidences) in zip(panels, designs.items(), strict=True):
        for panel, title, found in zip(row, titles, evidences, strict=True):
            probabilities = xr.apply_ufunc(
                softmax, found, kwargs={"axis": found.get_axis_num("model")}
            )
            _medians_and_bands(panel, probabilities)
            panel.set_title(f"measured {name}, {title}", fontsize="medium")
        row[0].set_ylabel("probability")
    for panel in panels[-1]:
        panel.set_xlabel("number of measurements J")
    panels[0, 0].legend(frameon=False, loc="center right")
    return figure


def _medians_and_bands(panel: Axes, found: xr.DataArray) -> None:
    for model in found["model"].values:
        low, middle, high = (
            found.sel(model=model).quantile([BAND[0], 0.5, BAND[1]], "record").values
        )
        (line,) = panel.plot(found["J"], middle, ".-", markersize=4, label=str(model))
        panel.fill_between(found["J"], low, high, color=line.get_color(), alpha=0.15, linewidth=0)
    panel.set_xscale("log")
    ticks = [5, 10, 20, 50, 100, 200]
    panel.set_xticks(ticks, labels=map(str, ticks))
    panel.minorticks_off()
