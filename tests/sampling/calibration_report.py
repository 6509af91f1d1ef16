"""What the calibration gave: the tables and the picture of ``docs/reference/calibration.md``.

Run with ``python -m tests.sampling.calibration_report`` from the root of the repository.
"""

from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np

from tests.sampling.calibration import (
    CONTROLS,
    N_BINS,
    N_RANKS,
    N_REPLICATIONS,
    SETTINGS,
    calibrate,
    p_values,
)
from tests.sampling.rank_uniformity import ecdf_band, ecdf_counts, histogram

STATIC = Path(__file__).parents[2] / "docs" / "_static"
COLOURS = {
    "phi": "#1b6ca8",
    "spread": "#d1792b",
    "log-likelihood": "#3f8f4f",
    "typical": "#222222",
    "phi of the first": "#7b5ea7",
    "phi of the last": "#b0476b",
}


def quantities_of(name):
    """Whose ranks a setting has."""
    return (SETTINGS | CONTROLS)[name].problem.quantities


def tables(results):
    """Markdown: ranks by setting and quantity, then chains by setting."""
    counts = f"ranks in {N_BINS} bins"
    lines = [f"| setting | quantity | p, chi-square | p, ECDF | {counts} |", "| --- " * 5 + "|"]
    for name, result in results.items():
        both = zip(quantities_of(name), result.ranks.T, p_values(result.ranks), strict=True)
        for quantity, ranks, (by_bins, by_ecdf) in both:
            bins = " ".join(map(str, histogram(ranks, N_RANKS, N_BINS)))
            lines.append(f"| {name} | {quantity} | {by_bins:.2g} | {by_ecdf:.2g} | {bins} |")
    heads = ("setting", "mean draws", "most draws", "correlation of kept neighbours", "seconds")
    lines += ["", f"| {' | '.join(heads)} |", "| --- " * len(heads) + "|"]
    for name, result in results.items():
        lag = result.lags.mean(axis=0).max()
        lengths = f"{result.lengths.mean():.0f} | {result.lengths.max()}"
        lines.append(f"| {name} | {lengths} | {lag:.2f} | {result.seconds:.0f} |")
    return "\n".join(lines) + "\n"


def picture(results, target):
    """ECDFs of the ranks less the uniform one, with the band that holds all of 99 %."""
    figure, panels = plt.subplots(
        2, 5, figsize=(13, 5), sharex=True, sharey="row", layout="constrained"
    )
    places = np.arange(1, N_RANKS) / N_RANKS
    low, high = ecdf_band(N_REPLICATIONS, N_RANKS, error_rate=0.01)
    rows = (list(SETTINGS), list(CONTROLS))
    for row, names in zip(panels, rows, strict=True):
        for axis, name in zip(row, names, strict=False):
            axis.fill_between(
                places,
                low / N_REPLICATIONS - places,
                high / N_REPLICATIONS - places,
                color="#dddddd",
            )
            for ranks, quantity in zip(results[name].ranks.T, quantities_of(name), strict=True):
                share = ecdf_counts(ranks, N_RANKS) / N_REPLICATIONS
                axis.plot(
                    places, share - places, color=COLOURS[quantity], label=quantity, linewidth=1.2
                )
            axis.set_title(name, fontsize=9)
            axis.spines[["top", "right"]].set_visible(False)
    panels[0, 0].set_ylabel("right samplers:\nECDF less uniform", fontsize=9)
    panels[1, 0].set_ylabel("wrong on purpose:\nECDF less uniform", fontsize=9)
    figure.supxlabel("rank of the true value, as a share", fontsize=9)
    panels[1, -1].axis("off")
    shown = {}
    for panel in (panels[0, 0], panels[0, -1]):
        shown |= dict(zip(*panel.get_legend_handles_labels()[::-1], strict=True))
    figure.legend(shown.values(), shown, loc="outside right center", frameon=False)
    figure.savefig(target, dpi=110)


def main():
    results = {name: calibrate(setting) for name, setting in (SETTINGS | CONTROLS).items()}
    (STATIC / "calibration.inc").write_text(tables(results))
    picture(results, STATIC / "calibration.png")


if __name__ == "__main__":
    main()
