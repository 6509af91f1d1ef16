"""What a chain knows of its own health, and what it says when it ends."""

from typing import NamedTuple

from pymc.stats.convergence import SamplerWarning, WarningType

from pymc_statespace_filters.inspection import FAILURES
from pymc_statespace_filters.sampling.log_density import NOT_A_NUMBER

# Share of evaluations after warm-up that may fail in silence: a chain that brushes the edge of the
# region where its filter works is normal.
TOLERATED_FAILURES = 0.05


# Share of accepted proposals below which a chain says nothing about its target.
STANDING = 0.005

# Share of the draws that may rest on collapsed particles: a rare surprise costs only mixing.
TOLERATED_COLLAPSES = 0.5


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
    """

    iterations: int = 0
    moved: int = 0
    evaluations: int = 0
    failures: tuple[tuple[int, int], ...] = ()
    collapsed: int = 0

    def include(self, moved: bool, codes: tuple[int, ...], collapsed: bool = False) -> "Record":
        """Take in an iteration: whether it moved, each evaluation's failure code (0: none)."""
        failures = self.failures
        if any(codes):
            counts = dict(failures)
            for code in filter(None, codes):
                counts[code] = counts.get(code, 0) + 1
            failures = tuple(counts.items())
        return Record(
            self.iterations + 1,
            self.moved + moved,
            self.evaluations + len(codes),
            failures,
            self.collapsed + collapsed,
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


def closing_warning(record: Record) -> SamplerWarning | None:
    """Say what went wrong after warm-up, if anything did.

    Parameters
    ----------
    record : Record
        Of the iterations after warm-up, all of them.

    Returns
    -------
    pymc.stats.convergence.SamplerWarning or None
        PyMC logs it in the main process, in whichever process the chain ran.
    """
    if record.moved <= STANDING * record.iterations:
        return _warning(
            f"DRAM accepted {record.moved} of {record.iterations} proposals after warm-up: the "
            "chain hardly moves. Tune longer, start elsewhere (initvals), give proposal_cov, or, "
            "if the likelihood is noisy, give its filter more particles."
        )
    if record.collapsed > TOLERATED_COLLAPSES * record.iterations:
        return _warning(
            f"In {record.collapsed} of {record.iterations} draws hardly more than one particle "
            "decided the estimated likelihood at some observation (sample_stats n_effective). Such "
            "estimates scatter by many nats, and a chain is slow to leave one that came out high. "
            "More particles lessen this only slowly."
        )
    n_failed = sum(count for _, count in record.failures)
    if n_failed > TOLERATED_FAILURES * record.evaluations:
        counted = "; ".join(f"{reason(code)} ({count})" for code, count in record.failures)
        return _warning(
            f"{n_failed} of {record.evaluations} evaluations after warm-up failed and counted as "
            f"impossible: {counted}. If the posterior reaches into that region it is cut off there."
        )
    return None


def _warning(message: str) -> SamplerWarning:
    return SamplerWarning(WarningType.BAD_ACCEPTANCE, message, "warn")
