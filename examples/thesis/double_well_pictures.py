"""The figures of section 5.2: states, marginal densities, and the force as a curve."""

from collections.abc import Mapping

import arviz as az
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

COLOURS = {
    "EKF": "C3",
    "EnKF": "C0",
    "PFEnKF": "C2",
    "BootstrapPF": "C1",
    "GridFilter": "C1",
    "M1": "C7",
    "M2": "C0",
    "M3": "C3",
}
SYMBOLS = {"alpha": "α", "beta": "β", "gamma": "γ", "sigma_m": "σ$_m$"}


def draw_states(record: xr.Dataset, states: Mapping[str, xr.Dataset]) -> Figure:
    """Plot each filter's states at the true parameters (Figs. 12, 16, 20)."""
    figure, axes = plt.subplots(
        len(states),
        1,
        figsize=(8, 1.5 * len(states) + 0.4),
        sharex=True,
        sharey=True,
        layout="constrained",
    )
    for axis, (name, run) in zip(axes, states.items(), strict=True):
        mean, sd = run["mean"].isel(state=0), run["sd"].isel(state=0)
        ends = mean - 2 * sd, mean + 2 * sd
        axis.fill_between(run["time"], *ends, alpha=0.25, color=COLOURS[name], lw=0)
        axis.plot(run["time"], mean, color=COLOURS[name], lw=1.2, label=f"{name}, ± 2 sd")
        axis.plot(record["time"], record["states"].isel(state=0), "k", lw=0.6, label="path")
        axis.plot(record["obs_time"], record["observations"], "ok", markersize=2.5)
        axis.set(ylim=(-2.4, 2.4), ylabel="x")
        axis.legend(frameon=False, fontsize=8, ncols=2, loc="upper right")
    axes[-1].set_xlabel("time [s]")
    return figure


def draw_measurements(records: Mapping[int, xr.Dataset]) -> Figure:
    """Plot the potential and a histogram of each case's measurements (Figs. 11, 13, 17, 21)."""
    figure, axes = plt.subplots(
        1, 1 + len(records), figsize=(9, 2.3), sharex=True, layout="constrained"
    )
    x = np.linspace(-2, 2, 201)
    axes[0].plot(x, x**4 - 2 * x**2, "k")
    axes[0].set(title="potential", ylabel="x⁴ - 2 x²", ylim=(-1.3, 3))
    for axis, (case, record) in zip(axes[1:], records.items(), strict=True):
        values = record["observations"].values.ravel()
        axis.hist(values, bins=np.linspace(-2, 2, 21), color="0.6", edgecolor="w")
        axis.set(title=f"case {case}", ylabel="measurements")
    for axis in axes:
        axis.set(xlabel="x")
    return figure


def draw_marginals(posteriors: Mapping, truth: Mapping[str, float]) -> Figure:
    """Plot parameters (rows) by filters (columns), one line per equation (Figs. 14, 18, 22).

    Heights are scaled to be equal: a posterior ten times as narrow would hide the others.
    """
    filters = list(dict.fromkeys(name for name, _ in posteriors))
    figure, axes = plt.subplots(
        len(SYMBOLS),
        len(filters),
        figsize=(2.3 * len(filters), 6),
        sharex="row",
        squeeze=False,
        layout="constrained",
    )
    for (filter, model), post in posteriors.items():
        column = axes[:, filters.index(filter)]
        for axis, name in zip(column, SYMBOLS, strict=True):
            if name in post.draws["posterior"]:
                x, density, _ = az.kde(post.draws["posterior"][name].values.ravel(), bw="silverman")
                axis.plot(x, density / density.max(), color=COLOURS[model], lw=1.3, label=model)
    for row, name in zip(axes, SYMBOLS, strict=True):
        for axis in row:
            axis.axvline(truth[name], color="k", ls="--", lw=0.8)
            axis.set(xlabel=SYMBOLS[name], yticks=[])
            axis.spines[["left", "right", "top"]].set_visible(False)
    for axis, filter in zip(axes[0], filters, strict=True):
        axis.set_title(filter, fontsize=10)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    figure.supylabel("posterior density, to equal height", fontsize=10)
    return figure


def draw_forces(forces: Mapping[tuple[int, str, str], xr.DataArray], truth: xr.DataArray) -> Figure:
    """Plot the force averaged over the equations (Figs. 15, 19, 23).

    Parameters
    ----------
    forces : mapping of (case, prior, filter) to xarray.DataArray
        Expected force along ``x``.
    truth : xarray.DataArray
    """
    cases = list(dict.fromkeys(case for case, _, _ in forces))
    priors = list(dict.fromkeys(prior for _, prior, _ in forces))
    figure, axes = plt.subplots(
        len(cases),
        len(priors),
        figsize=(8, 2.5 * len(cases)),
        sharex=True,
        squeeze=False,
        layout="constrained",
    )
    for (case, prior, filter), force in forces.items():
        axis = axes[cases.index(case), priors.index(prior)]
        axis.plot(force["x"], force, color=COLOURS[filter], lw=1.4, label=filter)
    for case, row in zip(cases, axes, strict=True):
        for prior, axis in zip(priors, row, strict=True):
            axis.plot(truth["x"], truth, "k--", lw=1, label="truth")
            axis.set_title(f"case {case}, {prior}", fontsize=10)
            axis.set(ylim=(-30, 30), ylabel="force")
    for axis in axes[-1]:
        axis.set_xlabel("x")
    axes[0, 0].legend(frameon=False, fontsize=8, loc="lower left")
    return figure
