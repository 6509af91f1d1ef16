"""Draw the first figure of the paper: the log-likelihood of each filter on a sparse record.

``make paper`` runs it. It takes half a minute of one core and writes ``paper/likelihoods.png``. The
second figure of the paper is the one that ``make demo`` draws.
"""

import warnings
from pathlib import Path

import matplotlib
import numpy as np

import pymc_statespace_filters as psf
from benchmarks.by_system import measure
from benchmarks.by_system_records import of_guided
from benchmarks.guided import sparse

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

FIGURE = Path(__file__).parent / "likelihoods.png"
ALPHAS = np.linspace(1.0, 6.0, 41)
SIZES = (32, 100, 316, 1000, 3162, 10_000)
N_SEEDS = 20

COLOURS = {"EKF": "C7", "UKF": "C5", "EnKF": "C1", "BootstrapPF": "C0", "GuidedPF": "C3"}
DETERMINISTIC = {"EKF": psf.EKF(), "UKF": psf.UKF()}
NOISY = {"EnKF": psf.EnKF, "BootstrapPF": psf.BootstrapPF, "GuidedPF": psf.GuidedPF}
PROFILED = {
    "EKF": psf.EKF(),
    "EnKF(1000)": psf.EnKF(1000),
    "BootstrapPF(1000)": psf.BootstrapPF(1000),
    "GuidedPF(100)": psf.GuidedPF(100),
}


def log_likelihoods(case, filter, alphas: np.ndarray, n_seeds: int) -> np.ndarray:
    """Return the log-likelihood at every alpha for every seed, of shape (alpha, seed)."""
    given = case.given | {"alpha": alphas[:, None]}
    seeds = np.arange(n_seeds) if filter.noisy else np.zeros(1, int)
    with warnings.catch_warnings():
        # Filters that collapse are what the figure shows.
        warnings.simplefilter("ignore", psf.errors.FilterWarning)
        terms = psf.log_likelihood(
            case.system, filter, given, case.observed, steps=case.steps, seed=seeds
        )
    return terms.sum(axis=-1)


def along_alpha(axes: Axes, case, alphas: np.ndarray, n_seeds: int) -> None:
    """Plot log-likelihoods against alpha: the median, the lowest and the highest of the seeds."""
    for name, filter in PROFILED.items():
        found = log_likelihoods(case, filter, alphas, n_seeds)
        colour = COLOURS[name.partition("(")[0]]
        axes.plot(alphas, np.median(found, axis=1), color=colour, label=name)
        band = found.min(axis=1), found.max(axis=1)
        axes.fill_between(alphas, *band, color=colour, alpha=0.2, lw=0)
    exact = log_likelihoods(case, case.grid, alphas, 1)
    axes.plot(alphas, exact[:, 0], "k--", label="GridFilter (exact)")
    axes.axvline(case.given["alpha"], color="k", lw=0.6, ls=":")
    axes.set(xlabel="α", ylabel="log-likelihood [nats]", xlim=alphas[[0, -1]], ylim=(-58, -11))
    axes.legend(frameon=False, fontsize=8, handlelength=1.3, borderaxespad=0.2, loc="lower left")


def error_against_time(axes: Axes, case, sizes: tuple[int, ...]) -> None:
    """Plot root-mean-square errors at the true parameters against the time of an evaluation."""
    exact = float(log_likelihoods(case, case.grid, np.array([case.given["alpha"]]), 1)[0, 0])
    for name, filter in DETERMINISTIC.items():
        cell = measure(case, filter, exact)
        axes.plot(cell.ms, abs(cell.mean), "s", color=COLOURS[name], label=name)
    for name, of_size in NOISY.items():
        cells = [measure(case, of_size(size), exact) for size in sizes]
        errors = [np.sqrt(np.mean(cell.errors**2)) for cell in cells]
        axes.plot([cell.ms for cell in cells], errors, "o-", color=COLOURS[name], ms=4, label=name)
    time = measure(case, case.grid, exact).ms
    axes.axvline(time, color="k", ls="--", label="GridFilter (exact)")
    axes.set(
        xlabel="CPU time of an evaluation [ms]",
        ylabel="error of the log-likelihood [nats]",
        xscale="log",
        yscale="log",
    )
    axes.legend(frameon=False, fontsize=8, handlelength=1.3, borderaxespad=0.2, loc="lower left")


def draw(
    path: Path = FIGURE,
    alphas: np.ndarray = ALPHAS,
    sizes: tuple[int, ...] = SIZES,
    n_seeds: int = N_SEEDS,
) -> None:
    """Draw both panels."""
    case = of_guided("double well, sparse", sparse())
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.4), layout="constrained")
    along_alpha(left, case, alphas, n_seeds)
    error_against_time(right, case, sizes)
    figure.savefig(path, dpi=150)
    plt.close(figure)


if __name__ == "__main__":
    draw()
