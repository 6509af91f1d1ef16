"""What a chain has done in a phase, in numbers: moves, failures, collapses and stays."""

import math
from typing import NamedTuple

import numpy as np

from ...filters.outcomes import COLLAPSED
from ..kernel.record_arrays import N_POPULATION_MOVES
from ..kernel.state import (
    FAILURE,
    N_COMMON_BLOCKS,
    N_COUNTS,
    N_EFFECTIVE,
    N_EVALUATIONS,
    N_FAILED,
    N_SCREEN_FAILED,
    N_SCREENED,
    STAGE,
    Draws,
    n_accepted,
)


class PhaseStatistics(NamedTuple):
    """Counts of a chain in one phase, warm-up or sampling."""

    iterations: int = 0
    moved: float = 0  # iterations that accepted a proposal; the mean of all records
    evaluations: int = 0  # of the model
    failures: tuple[tuple[int, int], ...] = ()  # failure codes and their counts
    collapsed: int = 0  # iterations at an estimate with an effective number of particles near one
    screened: int = 0  # evaluations of the screen
    screen_failed: int = 0
    dwell: int = 0  # iterations at the current point
    longest_dwell: int = 0  # at any point
    slowest: int | None = None  # number of the record of the longest dwell
    # If records are moved one by one: acceptance rates of each, of the shared parameters and of the
    # moves of the population, NaN without these.
    by_record: tuple[float, ...] = ()
    shared_rate: float = math.nan
    population_rate: float = math.nan

    def include(self, draws: Draws, row: int) -> "PhaseStatistics":
        """Add an iteration."""
        counts = draws.counts[row].tolist()
        failures = self.failures
        if counts[N_FAILED]:
            by_code = dict(failures)
            code = counts[FAILURE]
            by_code[code] = by_code.get(code, 0) + counts[N_FAILED]
            failures = tuple(by_code.items())
        dwell = 1 if counts[STAGE] else self.dwell + 1
        return PhaseStatistics(
            self.iterations + 1,
            self.moved + (counts[STAGE] > 0),
            self.evaluations + counts[N_EVALUATIONS],
            failures,
            self.collapsed + (float(draws.numbers[row, N_EFFECTIVE]) < COLLAPSED),
            self.screened + counts[N_SCREENED],
            self.screen_failed + counts[N_SCREEN_FAILED],
            dwell,
            max(dwell, self.longest_dwell),
        )

    @classmethod
    def from_draws(cls, draws: Draws, begin: int, end: int, thin: int = 1) -> "PhaseStatistics":
        """Count the iterations from row ``begin`` to before row ``end``, ``thin`` for each."""
        counts = draws.counts[begin:end]
        codes = counts[:, FAILURE]
        failures = tuple(
            (int(code), int(counts[codes == code, N_FAILED].sum()))
            for code in np.unique(codes[counts[:, N_FAILED] > 0])
        )
        n, accepted = thin * len(counts), n_accepted(counts)
        rates = accepted.sum(axis=0) / max(n, 1)
        dwells = [_dwells(np.flatnonzero(of_part), len(counts), thin) for of_part in accepted.T]
        slowest = int(np.argmax([of_part.max() for of_part in dwells]))
        statistics = cls(
            n,
            float(rates.mean() * n),
            int(counts[:, N_EVALUATIONS].sum()),
            failures,
            thin * int(np.count_nonzero(draws.numbers[begin:end, N_EFFECTIVE] < COLLAPSED)),
            int(counts[:, N_SCREENED].sum()),
            int(counts[:, N_SCREEN_FAILED].sum()),
            int(dwells[slowest][-1]),
            int(dwells[slowest].max()),
        )
        if counts.shape[1] == N_COUNTS:
            return statistics
        shared, population = (counts[:, -N_COMMON_BLOCKS:].sum(axis=0) / max(n, 1)).tolist()
        return statistics._replace(
            slowest=slowest,
            by_record=tuple(rates.tolist()),
            shared_rate=shared,
            population_rate=population / N_POPULATION_MOVES,
        )

    @property
    def accept_rate(self) -> float:
        """Fraction of the iterations that accepted a proposal."""
        return self.moved / self.iterations if self.iterations else 0.0


def _dwells(moved: np.ndarray, n: int, thin: int) -> np.ndarray:
    """Iterations at each point at least, if these rows of n have moved, once or more often."""
    dwells = thin * np.diff(moved, prepend=0, append=n)
    dwells[1:] -= thin - 1  # a row that has moved may have done so at its end
    return dwells
