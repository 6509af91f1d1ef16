"""Figures of the study of a wing section."""

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from airfoil_section import DT, SPEEDS, TRUTHS, pitch_moment
from matplotlib.figure import Figure


def draw_records(records: Mapping[str, Any]) -> Figure:
    """Plot the two records: pitch and plunge, the motion and its measurements."""
    figure, panels = plt.subplots(2, 2, figsize=(10, 5), sharex=True, layout="constrained")
    for row, (name, record) in zip(panels, records.items(), strict=True):
        times, scale = DT * np.arange(len(record.states)), {"pitch": (1, 180 / np.pi, "°")}
        scale["plunge"] = (0, 1000.0, "mm")
        for panel, (what, (i, factor, unit)) in zip(row, scale.items(), strict=True):
            panel.plot(times, factor * record.states[:, i], color="0.75", lw=0.7, label="motion")
            seen = factor * record.observed[:, i]
            panel.plot(DT * record.steps, seen, ".k", ms=3, label="measured")
            panel.axvline(times[-1] / 2, color="C3", lw=1)
            panel.set(ylabel=f"{what} [{unit}]", title=f"made by the {name} spring")
        high = 1.35 * np.abs(row[0].dataLim.intervaly).max()
        row[0].set_ylim(-high, high)
        for where, speed in zip((0.25, 0.75), SPEEDS, strict=True):
            label = f"{speed:.0f} m/s"
            row[0].text(where, 0.93, label, transform=row[0].transAxes, ha="center", color="C3")
    panels[0, 1].legend(loc="upper right", ncols=2, frameon=False, fontsize="small")
    for panel in panels[1]:
        panel.set_xlabel("time [s]")
    return figure


def draw_moments(curves: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Plot the averaged moment of the pitch spring by each comparison, and the truth."""
    figure, panels = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for panel, (name, by) in zip(panels, curves.items(), strict=True):
        for i, (label, moment) in enumerate(by.items()):
            angle = moment["angle"]
            low, middle, high = moment.quantile([0.05, 0.5, 0.95], ["chain", "draw"])
            panel.fill_between(np.rad2deg(angle), low, high, color=f"C{i}", alpha=0.25, lw=0)
            panel.plot(np.rad2deg(angle), middle, color=f"C{i}", label=label)
        truth = pitch_moment(angle.values, TRUTHS[name])
        panel.plot(np.rad2deg(angle), truth, "--k", lw=1.2, label="truth")
        panel.set(title=f"record made by the {name} spring", xlabel="pitch [°]")
        panel.set(ylabel="moment of the pitch spring [N m]")
    panels[0].legend(frameon=False)
    return figure


def draw_peaks(peaks: Mapping[str, Mapping[str, np.ndarray]], speed: float) -> Figure:
    """Plot the predicted largest pitch at a new speed and that of the true section."""
    figure, panels = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for panel, (name, by) in zip(panels, peaks.items(), strict=True):
        edges = np.linspace(6.0, 1.2 * np.max(by["truth"]), 61)
        for i, (label, values) in enumerate(by.items()):
            colour = "k" if label == "truth" else f"C{i}"
            heights, _ = np.histogram(values, edges, density=True)
            panel.stairs(heights, edges, color=colour, label=label, lw=1.5)
        panel.set(title=f"record made by the {name} spring", yticks=[], ylim=(0, None))
        panel.set(xlabel=f"largest pitch in two seconds at {speed:.0f} m/s [°]")
        panel.spines[["left", "right", "top"]].set_visible(False)
    panels[0].set_ylabel("density")
    panels[0].legend(frameon=False)
    return figure
