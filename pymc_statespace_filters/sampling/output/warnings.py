"""What a chain knows of its own health, and what it says when it ends."""

from typing import NamedTuple

import numpy as np
from pymc.stats.convergence import SamplerWarning, WarningType

from pymc_statespace_filters.pymc_model.inspection import COLLAPSED, FAILURES
from pymc_statespace_filters.sampling.kernel.state import (
    FAILURE,
    N_EFFECTIVE,
    N_EVALUATIONS,
    N_FAILED,
    N_SCREEN_FAILED,
    N_SCREENED,
    NOT_A_NUMBER,
    STAGE,
    Draws,
)

# Share of evaluations after warm-up that may fail in silence: a chain that brushes the edge of the
# region where its filter works is normal.
TOLERATED_FAILURES = 0.05

# Share of accepted proposals below which a chain says nothing about its target.
STANDING = 0.005

# Share of a chain's draws, and their number, above which a stay at one point is no chance: at an
# acceptance of 5 % it lasts more than a hundred iterations once in 170 stays.
LONG_STAY, LEAST_STAY = 0.2, 100

# How many times wider than the prior's draws the proposals may become. A proper prior leaves them
# narrower; under a flat one the units of the model's starting point stand in for its draws.
TOLERATED_GROWTH = 1e3

# Share of the draws that may rest on collapsed particles: a rare surprise costs only mixing.
TOLERATED_COLLAPSES = 0.5


class Growth(NamedTuple):
    """The variable whose proposals have grown most, in multiples of its prior's draws.

    Attributes
    ----------
    name : str
    factor : float
    """

    name: str
    factor: float


class Record(NamedTuple):
    """Counts of a chain in its present phase, warm-up or sampling.

    Attributes
    ----------
    iterations, moved : int
        Iterations, and how many accepted a proposal.
    evaluations : int
        Evaluations of the model.
    failures : tuple of (int, int)
        Pairs of a failure's code and its count.
    collapsed : int
        Iterations that ended at an estimate which hardly more than one particle decided.
    screened, screen_failed : int
        Evaluations of the screen, and how many failed.
    stay, longest_stay : int
        Iterations that have ended at the present point, and most at any point.
    """

    iterations: int = 0
    moved: int = 0
    evaluations: int = 0
    failures: tuple[tuple[int, int], ...] = ()
    collapsed: int = 0
    screened: int = 0
    screen_failed: int = 0
    stay: int = 0
    longest_stay: int = 0

    def include(self, draws: Draws, row: int) -> "Record":
        """Take in an iteration."""
        counts = draws.counts[row].tolist()
        failures = self.failures
        if counts[N_FAILED]:
            by_code = dict(failures)
            code = counts[FAILURE]
            by_code[code] = by_code.get(code, 0) + counts[N_FAILED]
            failures = tuple(by_code.items())
        stay = 1 if counts[STAGE] else self.stay + 1
        return Record(
            self.iterations + 1,
            self.moved + (counts[STAGE] > 0),
            self.evaluations + counts[N_EVALUATIONS],
            failures,
            self.collapsed + (float(draws.numbers[row, N_EFFECTIVE]) < COLLAPSED),
            self.screened + counts[N_SCREENED],
            self.screen_failed + counts[N_SCREEN_FAILED],
            stay,
            max(stay, self.longest_stay),
        )

    @classmethod
    def of(cls, draws: Draws, begin: int, end: int) -> "Record":
        """Count what was noted down of the iterations from ``begin`` to before ``end``."""
        counts = draws.counts[begin:end]
        codes = counts[:, FAILURE]
        failures = tuple(
            (int(code), int(counts[codes == code, N_FAILED].sum()))
            for code in np.unique(codes[counts[:, N_FAILED] > 0])
        )
        arrivals = np.flatnonzero(counts[:, STAGE])
        stays = np.diff(arrivals, prepend=0, append=len(counts))
        return cls(
            len(counts),
            int(np.count_nonzero(counts[:, STAGE])),
            int(counts[:, N_EVALUATIONS].sum()),
            failures,
            int(np.count_nonzero(draws.numbers[begin:end, N_EFFECTIVE] < COLLAPSED)),
            int(counts[:, N_SCREENED].sum()),
            int(counts[:, N_SCREEN_FAILED].sum()),
            int(stays[-1]),
            int(stays.max()),
        )

    @property
    def accept_rate(self) -> float:
        """Share of the iterations that moved."""
        return self.moved / self.iterations if self.iterations else 0.0


def reason(code: int) -> str:
    """Put a failure's code in words."""
    if code == NOT_A_NUMBER:
        return "the log-density is NaN or plus infinity"
    return FAILURES.get(code, f"failure {code}")


def closing_warning(record: Record, growth: Growth | None = None) -> SamplerWarning | None:
    """Say what went wrong after warm-up, if anything did.

    Parameters
    ----------
    record : Record
        Of the iterations after warm-up, all of them.
    growth : Growth, optional
        Of the proposals that warm-up has taught.

    Returns
    -------
    pymc.stats.convergence.SamplerWarning or None
        PyMC logs it in the main process, in whichever process the chain ran.
    """
    if record.moved <= STANDING * record.iterations:
        screen = " or, with a screen, lower screen_power" if record.screened else ""
        return warning(
            f"DRAM accepted {record.moved} of {record.iterations} proposals after warm-up: the "
            "chain hardly moves. Tune longer, start elsewhere (initvals), give proposal_cov, or, "
            f"if the likelihood is noisy, give its filter more particles{screen}."
        )
    if record.screen_failed > TOLERATED_FAILURES * record.screened:
        return warning(
            f"The screen failed in {record.screen_failed} of {record.screened} proposals after "
            "warm-up, which were rejected unseen: if the posterior reaches into that region it is "
            "cut off there. Another screen, or none, helps; a lower screen_power does not."
        )
    if record.longest_stay > max(LEAST_STAY, LONG_STAY * record.iterations):
        return warning(
            f"DRAM stood at one point for {record.longest_stay} of {record.iterations} draws. If "
            "the likelihood is noisy, its estimate there came out high: give its filter more "
            "particles (psf.suggest_particles). Else its proposals do not lead away from there: "
            "tune longer, start elsewhere (initvals), or give proposal_cov."
        )
    if growth is not None and growth.factor > TOLERATED_GROWTH:
        return warning(
            f"The proposals of {growth.name} have become {growth.factor:.2g} times wider than its "
            "prior's draws (under a flat prior: than 1). If data and prior leave it free, its "
            "draws run away and mean nothing: give it a proper prior. If it is only large, start "
            "near it (initvals) and give proposal_cov."
        )
    if record.collapsed > TOLERATED_COLLAPSES * record.iterations:
        return warning(
            f"In {record.collapsed} of {record.iterations} draws hardly more than one particle "
            "decided the estimated likelihood at some observation (sample_stats n_effective). Such "
            "estimates scatter by many nats, and a chain is slow to leave one that came out high. "
            "More particles lessen this only slowly."
        )
    n_failed = sum(count for _, count in record.failures)
    if n_failed > TOLERATED_FAILURES * record.evaluations:
        counted = "; ".join(f"{reason(code)} ({count})" for code, count in record.failures)
        return warning(
            f"{n_failed} of {record.evaluations} evaluations after warm-up failed and counted as "
            f"impossible: {counted}. If the posterior reaches into that region it is cut off there."
        )
    return None


def warning(message: str) -> SamplerWarning:
    """Make of a message what PyMC's logger takes."""
    return SamplerWarning(WarningType.BAD_ACCEPTANCE, message, "warn")
