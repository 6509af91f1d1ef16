"""The tables of `efficiency`: medians over seeds, and the worst of them."""

from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.report import TARGET, cpu, number, table

if TYPE_CHECKING:
    from benchmarks.efficiency import Run

HEAD = [
    "posterior", "sampler", "seeds x draws", "ESS per 1000 evaluations", "of kept draws",
    "ESS per CPU second", "of kept draws", "R-hat, mean", "worst", "starts, of CPU time",
]  # fmt: skip
LONG_HEAD = ["posterior", "draws", "R-hat of each seed", "smallest ESS", "starts, of CPU time"]


def versions() -> str:
    """The installed samplers."""
    found = []
    for name in ("pymc", "nutpie", "pymcmcstat", "emcee"):
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} not installed")
    return ", ".join(found)


def grouped(runs: Sequence["Run"]) -> dict[tuple[str, str], list["Run"]]:
    """The runs of each row, in the order of their seeds."""
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in sorted(runs, key=lambda run: run.seed):
        groups.setdefault((run.posterior, run.sampler), []).append(run)
    return groups


def starts(group: list["Run"]) -> str:
    """The share of the starts, empty for samplers that search for none."""
    share = median(run.start_seconds / run.seconds for run in group)
    return f"{share:.0%}" if share else ""


def row(group: list["Run"]) -> list[str]:
    first = group[0]
    return [
        first.posterior,
        f"`{first.sampler}`" if "(" in first.sampler else first.sampler,
        f"{len(group)} x {first.draws}",
        number(median(1000 * run.ess / run.evaluations for run in group)),
        number(median(1000 * run.ess / run.kept_evaluations for run in group)),
        number(median(run.ess / run.seconds for run in group)),
        number(median(run.ess / run.kept_seconds for run in group)),
        f"{np.mean([run.rhat for run in group]):.3f}",
        f"{max(run.rhat for run in group):.3f}",
        starts(group),
    ]


def long_row(group: list["Run"]) -> list[str]:
    rhats = ", ".join(f"{run.rhat:.3f}" for run in group)
    smallest = f"{min(run.ess for run in group):.0f}"
    return [group[0].posterior, str(group[0].draws), rhats, smallest, starts(group)]


def write(runs: Sequence["Run"], posteriors: list[str], samplers: list[str], long: str) -> str:
    """Write the tables, in the order of these names; ``long`` is the sampler of the second."""
    groups = grouped(runs)
    keys = [(p, s) for p in posteriors for s in samplers if s != long]
    text = (
        f"Measured on {cpu()}; {versions()}; medians over seeds.\n\n"
        + table(HEAD, [row(groups[key]) for key in keys if key in groups])
        + "\nLong runs with default arguments, four chains:\n\n"
        + table(LONG_HEAD, [long_row(groups[p, long]) for p in posteriors if (p, long) in groups])
    )
    (TARGET / "benchmarks_efficiency.inc").write_text(text)
    return text
