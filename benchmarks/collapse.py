"""How often the warning of collapsed particles is missed or falsely given.

`BootstrapPF` and `GuidedPF` with ever more particles, 200 seeds each, on the records of one state
of `by_system`, against `GridFilter`. An estimate is bad if it is more than three nats off: missed
is the share of the bad ones without the warning, false the share of those within one nat with it.
Run it with ``python -m benchmarks.collapse`` from the root of the repository; it takes six minutes.
"""

from pathlib import Path

import numpy as np

import pymc_statespace_filters as psf
from benchmarks.by_system import truth
from benchmarks.by_system_records import Case, cases
from pymc_statespace_filters.filters.outcomes import COLLAPSED
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.system.given_record import GivenRecord
from pymc_statespace_filters.system.parameters import flat_parameters
from pymc_statespace_filters.system.record import read_record

TABLE = Path(__file__).parents[1] / "docs" / "_static" / "collapse_warning.inc"
RECORDS = ("double well", "double well, sparse", "surprises", "counts", "sign lost")
FILTERS = [psf.BootstrapPF(n) for n in (30, 100, 300, 1000, 3000)]
FILTERS += [psf.GuidedPF(n) for n in (30, 100, 300)]
N_SEEDS = 200
BAD, GOOD = 3.0, 1.0  # nats


def errors_and_warnings(case: Case, filter, exact: float) -> tuple[np.ndarray, np.ndarray]:
    """Of every seed: the error in nats, and whether the filter warns of collapse."""
    run = evaluator(LogLikelihood(case.system, filter))
    given = flat_parameters(case.system, case.given)
    record = read_record(
        case.system, GivenRecord(case.observed, steps=case.steps, inputs=case.inputs)
    ).arguments
    found = [run(given, *record, np.asarray(seed))[:2] for seed in range(N_SEEDS)]
    error = np.array([terms.sum() for terms, _ in found]) - exact
    return error, np.array([health[0] < COLLAPSED for _, health in found])


def share(part: np.ndarray, whole: np.ndarray) -> str:
    return f"{part.sum()} of {whole.sum()}" if whole.any() else "none"


def main() -> None:
    heads = "| filter | bad | missed | within a nat | falsely warned |"
    lines = [heads, "| --- " * 5 + "|"]
    chosen = [case for case in cases() if case.name in RECORDS]
    exact = {case.name: truth(case)[0] for case in chosen}
    for filter in FILTERS:
        found = [errors_and_warnings(case, filter, exact[case.name]) for case in chosen]
        error, warned = (np.concatenate(part) for part in zip(*found, strict=True))
        bad, good = ~(np.abs(error) <= BAD), np.abs(error) <= GOOD
        name = f"{type(filter).__name__}({filter.n_particles})"
        cells = bad.sum(), share(bad & ~warned, bad), good.sum(), share(good & warned, good)
        lines.append(f"| `{name}` | {' | '.join(map(str, cells))} |")
    TABLE.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
