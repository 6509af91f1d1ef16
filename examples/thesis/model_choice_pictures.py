"""Figures of the choice among the variants of the mass-spring-damper."""

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure
from oscillator import TRUTH, restoring_force

COLOURS = {"EKF": "C7", "EnKF": "C0", "PF-EnKF": "C3"}


def plot_probabilities(tables: Mapping[tuple[str, str], pd.DataFrame]) -> Figure:
    """Plot the probability of each variant, a panel for a record, a bar for a filter."""
    records = list(dict.fromkeys(record for record, _ in tables))
    figure, panels = plt.subplots(
        1, len(records), figsize=(4 + 3 * len(records), 4), sharey=True, squeeze=False
    )
    variants = sorted({v for table in tables.values() for v in table.index}, key=_size)
    places = pd.Series(np.arange(len(variants), dtype=float), variants)
    for record, panel in zip(records, panels[0], strict=True):
        filters = {name: table for (of, name), table in tables.items() if of == record}
        whole = {name: t for name, t in filters.items() if len(t) == len(variants)}
        height = 0.8 / len(whole)
        for number, (name, table) in enumerate(whole.items()):
            y = places[table.index] + height * (number - (len(whole) - 1) / 2)
            errors = [table["prob"] - table["prob_low"], table["prob_high"] - table["prob"]]
            panel.barh(y, table["prob"], height, color=COLOURS[name], label=name)
            panel.errorbar(
                table["prob"], y, xerr=np.clip(errors, 0, None), fmt="none", ecolor="k", lw=0.8
            )
        panel.set(title=record, xlabel="probability", xlim=(0, 1))
    panels[0, 0].set_yticks(places, variants)
    panels[0, 0].invert_yaxis()
    panels[0, -1].legend(frameon=False)
    figure.tight_layout()
    return figure


def _size(variant: str) -> tuple[int, str]:
    return (0 if variant == "linear" else variant.count("+") + 1, variant)


def plot_forces(averages: Mapping[str, xr.DataTree]) -> Figure:
    """Plot the averaged force on the way up and down, and its error, with 90 % bands."""
    figure, panels = plt.subplots(
        2,
        len(averages),
        figsize=(1.5 + 2.5 * len(averages), 4.8),
        sharex=True,
        sharey="row",
        squeeze=False,
    )
    for (record, average), (above, below) in zip(averages.items(), panels.T, strict=True):
        force = average["posterior"]["force"].isel(chain=0)
        places = force["displacement"].values
        for direction, sign, colour in (("up", 1.0, "C0"), ("down", -1.0, "C1")):
            truth = restoring_force(places, sign, TRUTH)
            quantiles = force.sel(direction=direction).quantile([0.05, 0.5, 0.95], "draw").values
            for panel, (low, middle, high) in ((above, quantiles), (below, quantiles - truth)):
                panel.fill_between(places, low, high, color=colour, alpha=0.3, lw=0)
                panel.plot(places, middle, color=colour, label=f"moving {direction}")
            above.plot(places, truth, "k--", lw=1, label="truth" if sign < 0 else None)
        above.set_title(record)
        below.set_xlabel("displacement [m]")
        below.axhline(0, color="k", ls="--", lw=1)
    panels[0, 0].set_ylabel("restoring force [N]")
    panels[1, 0].set_ylabel("averaged less true force [N]")
    panels[0, 0].legend(frameon=False)
    figure.tight_layout()
    return figure
