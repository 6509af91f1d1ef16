"""The two figures: times as multiples of ours, and growth curves."""

from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt

from benchmarks.growth import Curve
from benchmarks.measure import Row

OURS_COLOUR, OTHERS_COLOUR = "#1b6ca8", "#b0b7bd"


def bars(rows: list[Row], target: Path) -> None:
    """Plot a panel for each task: the times of all contenders divided by ours, on one log scale."""
    works = [
        [row for row in rows if row.work == work and row.timing]
        for work in dict.fromkeys(row.work for row in rows)
    ]
    works = [group for group in works if any(row.who == "ours" for row in group)]
    if not works:
        return
    heights = [len(group) + 1.2 for group in works]
    figure, axes = plt.subplots(
        len(works),
        1,
        sharex=True,
        squeeze=False,
        figsize=(8.5, 0.24 * sum(heights) + 0.6),
        gridspec_kw={"height_ratios": heights},
        layout="constrained",
    )
    for axis, group in zip(axes[:, 0], works, strict=True):
        ours = next(row.timing.median for row in group if row.who == "ours")
        group = sorted(group, key=lambda row: -row.timing.median)
        times = [row.timing.median / ours for row in group]
        colours = [OURS_COLOUR if row.who.startswith("ours") else OTHERS_COLOUR for row in group]
        # From 1, so that contenders faster than ours point to the left.
        axis.barh([row.who for row in group], [t - 1.0 for t in times], left=1.0, color=colours)
        for i, t in enumerate(times):
            axis.annotate(
                f"{t:.3g}" if t < 1000 else f"{t:.0f}",
                (max(t, 1.0), i),
                (4, 0),
                textcoords="offset points",
                va="center",
                fontsize=7,
            )
        axis.set_xscale("log")
        axis.axvline(1.0, color=OURS_COLOUR, linewidth=1)
        axis.set_title(group[0].work, loc="left", fontsize=8, fontweight="bold")
        axis.tick_params(labelsize=7)
        axis.margins(x=0.12)
        axis.spines[["top", "right"]].set_visible(False)
    axes[-1, 0].set_xlabel(
        "CPU time of a call, times ours (left of 1: faster than ours)", fontsize=8
    )
    figure.savefig(target, dpi=130)
    plt.close(figure)


def curves(growth: list[Curve], target: Path) -> None:
    """Plot the cost of a call against particles, steps and states."""
    kinds = list(dict.fromkeys(curve.against for curve in growth))
    if not kinds:
        return
    figure, axes = plt.subplots(
        1, len(kinds), figsize=(3.6 * len(kinds), 4.0), squeeze=False, layout="constrained"
    )
    for axis, against in zip(axes[0], kinds, strict=True):
        for curve in growth:
            if curve.against == against and curve.sizes:
                milliseconds = [1e3 * s for s in curve.seconds]
                style = "--" if "C++" in curve.who else "-"
                axis.loglog(curve.sizes, milliseconds, style, marker="o", ms=3, label=curve.who)
        axis.set_xlabel(against)
        axis.set_ylabel("CPU time of a call (ms)")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    figure.savefig(target, dpi=130)
    plt.close(figure)
