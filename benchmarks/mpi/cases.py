"""The likelihoods that are divided among ranks: the double well, 2001 states, 101 observations."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np

import pymc_statespace_filters as psf
from benchmarks.systems import DOUBLE_WELL, DOUBLE_WELL_TRUTH, STEPS, simulated, theta_of
from pymc_statespace_filters.filters.kernel_density import density as _kernel_density
from pymc_statespace_filters.ops.distributed import distributed_evaluator

EXACT, FAST, BOOTSTRAP, ENKF = "PFEnKF, exact kernels", "PFEnKF", "BootstrapPF", "EnKF"
FILTERS = {EXACT: psf.PFEnKF, FAST: psf.PFEnKF, BOOTSTRAP: psf.BootstrapPF, ENKF: psf.EnKF}
SIZES = (1000, 10_000, 100_000)
RANKS = (1, 2, 4, 8, 16, 20, 40, 100)
THREADS = (1, 2, 4, 8, 16)  # more at a time would disturb each other


class Ranks(Protocol):
    """The part of `Communicator` that a filter uses."""

    rank: int
    size: int
    exchange: int

    def check_exchange(self) -> None: ...


@dataclass(frozen=True)
class Case:
    """A filter with so many members, on the first ``n_seen`` observations of the record."""

    kind: str
    n: int
    n_seen: int = STEPS.size

    @property
    def name(self) -> str:
        return f"{self.kind}, {self.n}"

    @property
    def scale(self) -> float:
        """Factor from the measured part to the whole record."""
        return STEPS.size / self.n_seen

    def fits(self, n_ranks: int) -> bool:
        return n_ranks <= FILTERS[self.kind](self.n).max_ranks()


def cases(exact: bool) -> list[Case]:
    """Return the cases with exact kernel sums, or the others.

    The time of exact sums of many particles is nearly proportional to the number of observations.
    """
    if exact:
        return [Case(EXACT, n, seen) for n, seen in zip(SIZES, (STEPS.size, 5, 1), strict=True)]
    return [Case(kind, n) for kind in (FAST, BOOTSTRAP, ENKF) for n in SIZES]


def with_exact_kernels() -> None:
    """Switch the lattice off in this process, before anything is compiled.

    With one or two states the package does not use exact sums for so many particles; the thesis has
    no others. Their machine code must go to a separate cache.
    """
    _kernel_density._LINE_FROM = _kernel_density._PLANE_FROM = 2**62


@cache
def record() -> tuple[np.ndarray, np.ndarray]:
    return simulated(DOUBLE_WELL, DOUBLE_WELL_TRUTH)


def evaluation(case: Case, ranks: Ranks) -> Callable[[int], float]:
    """Return the log-likelihood, divided among ranks, as a function of a seed."""
    filter, steps = FILTERS[case.kind](case.n), STEPS[: case.n_seen]
    inputs, observed = record()
    theta = theta_of(DOUBLE_WELL, DOUBLE_WELL_TRUTH)
    seen = (steps, observed[: case.n_seen], inputs, np.asarray(0.0))

    evaluate = distributed_evaluator(DOUBLE_WELL, filter, ranks)

    def total(seed: int) -> float:
        terms, _ = evaluate(theta, *seen, np.asarray(seed))
        return float(terms.sum())

    return total
