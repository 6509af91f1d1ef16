"""Figures of the study of hidden states: a posterior and its filters, estimates over time."""

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import multivariate_normal, norm

COLOURS = {"EKF": "C0", "EnKF": "C1", "BootstrapPF": "C2", "PFEnKF": "C3"}
SHOWN = {"x": (-5.0, 6.5), "alpha": (-2.2, 3.8)}
LEVELS = (0.05, 0.2, 0.5, 0.8)  # of the highest density
N_POINTS = 500


def draw_case(title: str, exact: xr.DataArray, runs: Mapping[str, xr.Dataset]) -> Figure:
    """Plot the joint posterior, each filter's approximation, and both marginals."""
    figure = plt.figure(figsize=(8.2, 5), layout="constrained")
    above, below = figure.subfigures(2, 1)
    joints = above.subplots(1, len(runs), sharey=True)
    for axes, (name, run) in zip(joints, runs.items(), strict=True):
        _joint(axes, exact, run, COLOURS[name])
        axes.set(title=name, xlabel="x", xlim=SHOWN["x"], ylim=SHOWN["alpha"])
    joints[0].set_ylabel("alpha")
    marginals = below.subplots(1, 2)
    for axes, state in zip(marginals, ("x", "alpha"), strict=True):
        _marginal(axes, exact, runs, state)
    marginals[0].legend(frameon=False, fontsize=8)
    figure.suptitle(title)
    return figure


def _joint(axes: Axes, exact: xr.DataArray, run: xr.Dataset, colour: str) -> None:
    """Plot points of a filter, or ellipses of its normal distribution, on the exact density."""
    exact = exact[::20, ::5]  # as fine as the eye can see
    density = (exact / exact.max()).transpose("alpha", "x")
    levels, shades = [*LEVELS, 1.01], {"cmap": "Greys", "vmin": -0.3, "vmax": 1.6}
    axes.contourf(exact["x"], exact["alpha"], density, levels=levels, **shades)
    if "particles" not in run:
        grid = np.stack(np.meshgrid(exact["x"], exact["alpha"]), axis=-1)
        normal = multivariate_normal(run["mean"], run["cov"]).pdf(grid)
        axes.contour(
            exact["x"], exact["alpha"], normal / normal.max(), levels=LEVELS, colors=colour
        )
        return
    # Show a readable number of points, drawn by weight.
    weights = run["weights"].values
    chosen = np.random.default_rng(1).choice(weights.size, N_POINTS, p=weights)
    x, alpha = run["particles"].values[chosen].T
    axes.plot(x, alpha, ".", markersize=2, color=colour)


def _marginal(axes: Axes, exact: xr.DataArray, runs: Mapping[str, xr.Dataset], state: str) -> None:
    """Plot the density of one state: exact, normals, and histograms of weighted particles."""
    places = exact[state].values
    marginal = exact.sum({"x", "alpha"} - {state}) / (places[1] - places[0])
    axes.fill_between(places, marginal, color="0.8", label="exact")
    edges = np.linspace(*SHOWN[state], 47)
    for name, run in runs.items():
        here, look = run.sel(state=state), {"color": COLOURS[name], "label": name}
        if "particles" in run:
            density, _ = np.histogram(here["particles"], edges, weights=here["weights"])
            axes.stairs(density / np.diff(edges), edges, **look)
        else:
            axes.plot(places, norm.pdf(places, here["mean"], here["sd"]), **look)
    axes.set(xlabel=state, ylabel="density", xlim=SHOWN[state], ylim=(0, None))


def draw_estimates(
    runs: Mapping[str, list[xr.Dataset]], posterior: xr.Dataset, truth: Mapping[str, float]
) -> Figure:
    """Plot a filter's parameters over time as states, and their posterior on the right."""
    figure, axes = plt.subplots(
        len(truth), len(runs), sharex=True, sharey="row", figsize=(9, 4.6), layout="constrained"
    )
    for row, (parameter, value) in zip(axes, truth.items(), strict=True):
        low, high = posterior[parameter].quantile([0.05, 0.95])
        for panel, (name, several) in zip(row, runs.items(), strict=True):
            _estimate(panel, [run.sel(state=parameter) for run in several], COLOURS[name])
            panel.axhline(value, color="k", lw=0.8, ls="--", label="truth")
            end = float(several[0]["time"][-1]) * 1.03
            panel.plot([end, end], [low, high], "k", lw=4, label="posterior, 90 %")
        row[0].set_ylabel(parameter)
        centre = float(posterior[parameter].mean())
        row[0].set_ylim(centre - 5.0, centre + 5.0)
    for panel, name in zip(axes[0], runs, strict=True):
        panel.set_title(name)
    for panel in axes[-1]:
        panel.set_xlabel("time [s]")
    axes[0, 0].legend(frameon=False, fontsize=8, loc="lower right")
    return figure


def _estimate(axes: Axes, runs: list[xr.Dataset], colour: str) -> None:
    """Plot mean and 90 % band of the first run, and means of the others."""
    first, *others = runs
    half = 1.645 * first["sd"]
    axes.fill_between(
        first["time"], first["mean"] - half, first["mean"] + half, color=colour, alpha=0.25, lw=0
    )
    axes.plot(first["time"], first["mean"], color=colour)
    for run in others:
        axes.plot(run["time"], run["mean"], color=colour, lw=0.5, alpha=0.7)
