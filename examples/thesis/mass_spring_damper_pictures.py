"""The figures of the mass-spring-damper: forces, records and posteriors."""

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from oscillator import CASES, DT, LINEAR, NONLINEARITIES, TRUTH, restoring_force

UNITS = {
    "k_l": "N/m",
    "k_f": "N/m",
    "k_h": "N/m",
    "k_nl": "N/m³",
    "c": "Ns/m",
    "sigma": "N s$^{1/2}$",
    "delta_f": "m",
    "a_h": "m",
    "delta_h": "m",
}
COLOURS = {"EKF": "C0", "EnKF": "C1", "PFEnKF": "C2", "PFEnKF, weights": "C3"}


def forces() -> Figure:
    """Plot force against displacement, of each nonlinearity and of all (Figs. 24-28)."""
    u = np.linspace(-2.5, 2.5, 1001)
    figure, axes = plt.subplots(1, 5, figsize=(13, 3), layout="constrained", sharex=True)
    parts = {
        "cubic": {name: TRUTH[name] for name in ("k_l", "k_nl")},
        "freeplay": {name: TRUTH[name] for name in NONLINEARITIES["freeplay"]},
        "hysteresis": {name: TRUTH[name] for name in NONLINEARITIES["hysteresis"]},
        "all together": TRUTH,
    }
    for ax, (name, parameters) in zip(axes, parts.items(), strict=False):
        ax.set_title(name)
        _loop(ax, u, parameters, "C0")
    axes[0].set_ylabel("force [N]")
    for i, (name, parameters) in enumerate(parts.items()):
        _loop(axes[-1], u, parameters, f"C{i}", name)
    axes[-1].set(title="to one scale", ylim=(-8, 8))
    axes[-1].legend(frameon=False, fontsize=7, loc="upper left")
    for ax in axes:
        ax.set_xlabel("displacement [m]")
        ax.axhline(0, color="0.8", lw=0.8, zorder=0)
    return figure


def _loop(ax, u: np.ndarray, parameters: Mapping[str, float], colour: str, label="") -> None:
    up, down = (restoring_force(u, way, parameters) for way in (1.0, -1.0))
    ax.plot(u, up, colour, label=label)
    if not np.allclose(up, down):
        ax.plot(u, down, colour, ls="--")
        # Draw an arrow on each branch, away from the other one.
        for force, at, ahead in ((up, 450, 20), (down, 550, -20)):
            ax.annotate(
                "",
                (u[at + ahead], force[at + ahead]),
                (u[at], force[at]),
                arrowprops={"arrowstyle": "-|>", "color": colour},
            )


def records() -> Figure:
    """Plot the motions and their measurements (Figs. 29, 31, 33, 35)."""
    figure, axes = plt.subplots(
        len(CASES), 1, figsize=(9, 9), sharex=True, sharey=True, layout="constrained"
    )
    for ax, case in zip(axes, CASES.values(), strict=True):
        record = case.record()
        u = record["states"].sel(state="displacement")
        ax.plot(DT * np.arange(u.size), u, color="0.6", lw=1, label="displacement")
        ax.plot(DT * case.steps, record["observations"], "k.", ms=3, label="measured")
        ax.set_title(
            f"{case.name}: {case.steps.size} measurements, T = {case.T:g} N, Γ = {case.Gamma:g} m²",
            fontsize=10,
            loc="left",
        )
        ax.set_ylabel("u [m]")
    axes[0].legend(frameon=False, ncols=2, loc="upper right")
    axes[-1].set_xlabel("time [s]")
    return figure


def posteriors(name: str, found: Mapping[str, xr.DataTree]) -> Figure:
    """Plot marginal posteriors of a case by several filters; thin lines are single chains."""
    names = [*LINEAR, *(n for group in NONLINEARITIES.values() for n in group)]
    drawn = [n for n in names if not CASES[name].shared or n not in ("k_f", "k_h")]
    figure, axes = plt.subplots(-(-len(drawn) // 3), 3, figsize=(9, 6.5), layout="constrained")
    for ax in axes.flat[len(drawn) :]:
        ax.set_axis_off()
    for ax, parameter in zip(axes.flat, drawn, strict=False):
        draws = {label: tree["posterior"][parameter].values for label, tree in found.items()}
        pooled = np.concatenate([values.ravel() for values in draws.values()])
        edges = np.linspace(*np.quantile(pooled, [0.002, 0.998]), 41)
        highest = 0.0
        for label, values in draws.items():
            for chain in values:
                ax.stairs(_density(chain, edges), edges, color=COLOURS[label], lw=0.5, alpha=0.4)
            density = _density(values, edges)
            ax.stairs(density, edges, color=COLOURS[label], lw=1.8, label=label)
            highest = max(highest, density.max())
        ax.axvline(TRUTH[parameter], color="k", lw=1, ls="--", label="truth")
        shared = parameter == "k_l" and CASES[name].shared
        label = "k_l = k_f = k_h" if shared else parameter
        # A chain that did not move exceeds the height of the figure.
        ax.set(xlabel=f"{label} [{UNITS[parameter]}]", yticks=[], ylim=(0, 1.5 * highest))
        ax.spines[["left", "right", "top"]].set_visible(False)
    figure.legend(
        *axes.flat[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=5,
        frameon=False,
    )
    figure.suptitle(f"{name}: posterior densities, all chains (thick) and each (thin)", fontsize=11)
    return figure


def _density(draws: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.histogram(draws, edges)[0] / draws.size / np.diff(edges)
