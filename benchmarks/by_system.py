"""Which filter for which system: the error and the cost of every filter on twelve records.

The numbers are of the log-likelihood at the parameters that made the record, in nats: its mean over
noise seeds minus the exact one, its standard deviation over seeds, and CPU milliseconds of one
evaluation. Exact is `GridFilter` for one state and `EKF` for the linear system, otherwise the log
of the mean of fifty estimates by an unbiased filter with many particles. Run it with
``python -m benchmarks.by_system`` from the root of the repository; it takes a quarter of an hour.
Names of records as arguments select some of them.
"""

import sys
import time
import warnings
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp
from scipy.stats import norm

import pymc_statespace_filters as psf
from benchmarks.by_system_records import Case, cases
from pymc_statespace_filters.filters.checks import check_system_and_filter
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.system.given_record import GivenRecord
from pymc_statespace_filters.system.parameters import flat_parameters
from pymc_statespace_filters.system.record import read_record

N_SEEDS, LEAST_SEEDS, MOST_SECONDS = 50, 10, 60.0  # for one filter on one record
TRUTH_SEEDS = np.arange(50)

# The first eight are the columns of the table; the others are candidates of its last column.
FILTERS = {
    "EKF": psf.EKF(),
    "UKF": psf.UKF(),
    "IPLF": psf.IPLF(),
    "EnKF": psf.EnKF(1000),
    "BootstrapPF": psf.BootstrapPF(1000),
    "GuidedPF": psf.GuidedPF(100),
    "PFEnKF": psf.PFEnKF(1000),
    "GridFilter": psf.GridFilter(),
    "EnKF, gaussian": psf.EnKF(1000, likelihood="gaussian"),
    "BootstrapPF(100)": psf.BootstrapPF(100),
    "GuidedPF(1000)": psf.GuidedPF(1000),
}
GAUSSIAN = ("EKF", "UKF", "IPLF")


class Cell(NamedTuple):
    """A filter on a record: errors (n_seeds,) in nats, and CPU milliseconds of an evaluation."""

    errors: np.ndarray
    ms: float

    @property
    def mean(self) -> float:
        return float(self.errors.mean())

    @property
    def sd(self) -> float:
        finite = len(self.errors) > 1 and np.isfinite(self.mean)
        return float(self.errors.std(ddof=1)) if finite else 0.0

    def __str__(self) -> str:
        if not self.mean > -1000:
            return "below -1000"
        digits = 0 if max(abs(self.mean), self.sd) >= 10 else 1
        spread = f" ± {self.sd:.{digits}f}" if len(self.errors) > 1 else ""
        return f"{self.mean:+.{digits}f}{spread}"


def truth(case: Case) -> tuple[float, float]:
    """Return the exact log-likelihood and its standard error."""
    record = {"observed": case.observed, "steps": case.steps, "inputs": case.inputs}
    seeds = TRUTH_SEEDS if case.truth.noisy else 0
    terms = psf.log_likelihood(case.system, case.truth, case.given, **record, seed=seeds)
    totals = np.atleast_1d(terms.sum(axis=-1))
    total = logsumexp(totals) - np.log(totals.size)
    ratios = np.exp(totals - total)
    return float(total), float(ratios.std() / np.sqrt(totals.size))


def measure(case: Case, filter, exact: float) -> Cell:
    """Evaluate with fewer seeds than N_SEEDS where these would take longer than MOST_SECONDS."""
    if isinstance(filter, type(case.grid)):
        filter = case.grid
    check_system_and_filter(case.system, filter)
    run = evaluator(LogLikelihood(case.system, filter))
    given = flat_parameters(case.system, case.given)
    record = read_record(
        case.system, GivenRecord(case.observed, steps=case.steps, inputs=case.inputs)
    ).arguments
    totals = []
    run(given, *record, np.asarray(N_SEEDS))  # compiles
    start = time.process_time()
    for seed in range(N_SEEDS):
        totals.append(run(given, *record, np.asarray(seed))[0].sum())
        seconds = time.process_time() - start
        if seed + 1 >= LEAST_SEEDS and seconds > MOST_SECONDS:
            break
    errors = np.array(totals) - exact
    return Cell(errors if filter.noisy else errors[:1], 1e3 * seconds / len(totals))


def for_nuts(cells: dict[str, Cell]) -> str:
    """Name the Gaussian filter of least error, if that is below a nat.

    Errors that differ by less than a tenth are equal, and the cheapest wins.
    """
    errors = {name: abs(cells[name].mean) for name in GAUSSIAN if name in cells}
    least = min(errors.values(), default=np.inf)
    equal = [name for name, error in errors.items() if error < least + 0.1]
    return min(equal, key=lambda name: cells[name].ms) if least < 1.0 else "none"


def for_dram(cells: dict[str, Cell]) -> str:
    """Name the exact or unbiased filter of least CPU time per accepted move.

    Of the moves that an exact likelihood allows, an estimate of variance v leaves 2 Phi(-sqrt(v/2))
    if its errors are normal. A mean error that differs from -v / 2 tells that they are not: the
    likelihood is then right in the mean by rare seeds only.
    """
    prices = {}
    for name, cell in cells.items():
        v, n = cell.sd**2, len(cell.errors)
        if FILTERS[name].noisy:
            error = np.sqrt(v / n + v**2 / (2.0 * n))
            usable = FILTERS[name].unbiased and abs(cell.mean + v / 2) < 0.25 + 3.0 * error
        else:
            usable = abs(cell.mean) < 0.01
        if usable:
            prices[name] = cell.ms / (2.0 * norm.cdf(-np.sqrt(v / 2.0)))
    return min(prices, key=prices.__getitem__, default="none")


def main(selected: list[str]) -> None:
    print(f"| record | {' | '.join(FILTERS)} | for sample_dram | for NUTS |")
    print("| --- " * (len(FILTERS) + 3) + "|")
    for case in cases():
        if selected and case.name not in selected:
            continue
        exact, error = truth(case)
        cells, reasons = {}, {}
        for name, filter in FILTERS.items():
            try:
                cell = measure(case, filter, exact)
            except psf.errors.ModelError as refusal:
                reasons[name] = str(refusal)
            else:
                cells[name] = cell
        for show in (str, lambda cell: f"{cell.ms:.2g} ms"):
            row = [show(cells[name]) if name in cells else "-" for name in FILTERS]
            print(f"| {case.name} | {' | '.join(row)} | {for_dram(cells)} | {for_nuts(cells)} |")
        print(f"exact: {exact:.3f} +- {error:.3f} by {case.truth}")
        for name, reason in reasons.items():
            print(f"    {name}: {reason}")
        sys.stdout.flush()


if __name__ == "__main__":
    warnings.simplefilter("ignore", psf.errors.FilterWarning)
    main(sys.argv[1:])
