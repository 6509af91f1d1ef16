"""Statistics of a phase of a chain, and the warnings about chains when they have ended."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pymc.stats.convergence import SamplerWarning, WarningType

from ...filters.outcomes import COLLAPSED, Failure
from ...lower_chains import LowerChain, lower_chains
from ...progress import MIN_ACCEPT_RATE
from ..kernel.record_arrays import N_POPULATION_MOVES
from ..kernel.state import (
    FAILURE,
    LOG_DENSITY,
    N_COMMON_BLOCKS,
    N_COUNTS,
    N_EFFECTIVE,
    N_EVALUATIONS,
    N_FAILED,
    N_SCREEN_FAILED,
    N_SCREENED,
    STAGE,
    ChainState,
    Draws,
    has_moved,
)
from ..target.record_target import RecordTarget
from ..target.sampled_model import Growth
from ..target.target import Target

# Fraction of evaluations after warm-up that may fail without a warning: a chain that touches the
# edge of the region where its filter works is normal.
TOLERATED_FAILURES = 0.05

# Fraction of a chain's draws, and their number, above which a dwell time is not by chance: at an
# acceptance of 5 % one dwell time in 170 is longer than a hundred iterations.
LONG_DWELL, LEAST_DWELL = 0.2, 100

# Factor by which the proposals may be wider than the draws from the prior. With a proper prior they
# are narrower; under a flat one draws around the model's initial point replace its draws.
TOLERATED_GROWTH = 1e3

# Fraction of the draws whose particles may have collapsed: a rare surprise only costs mixing.
TOLERATED_COLLAPSES = 0.5


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
    def from_draws(cls, draws: Draws, begin: int, end: int) -> "PhaseStatistics":
        """Count the iterations from ``begin`` to before ``end``."""
        counts = draws.counts[begin:end]
        codes = counts[:, FAILURE]
        failures = tuple(
            (int(code), int(counts[codes == code, N_FAILED].sum()))
            for code in np.unique(codes[counts[:, N_FAILED] > 0])
        )
        moved = has_moved(counts)
        rates = moved.mean(axis=0) if len(counts) else np.zeros(moved.shape[1])
        dwells = [
            np.diff(np.flatnonzero(of_part), prepend=0, append=len(counts)) for of_part in moved.T
        ]
        slowest = int(np.argmax([of_part.max() for of_part in dwells]))
        statistics = cls(
            len(counts),
            float(rates.mean() * len(counts)),
            int(counts[:, N_EVALUATIONS].sum()),
            failures,
            int(np.count_nonzero(draws.numbers[begin:end, N_EFFECTIVE] < COLLAPSED)),
            int(counts[:, N_SCREENED].sum()),
            int(counts[:, N_SCREEN_FAILED].sum()),
            int(dwells[slowest][-1]),
            int(dwells[slowest].max()),
        )
        if counts.shape[1] == N_COUNTS:
            return statistics
        shared, population = counts[:, -N_COMMON_BLOCKS:].mean(axis=0).tolist()
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


def closing_warning(
    statistics: PhaseStatistics, growth: Growth | None = None, remedy: str = ""
) -> SamplerWarning | None:
    """Warn of what went wrong after warm-up, if anything did.

    ``growth`` is that of the adapted proposals, ``remedy`` what the model's filters can do about
    collapse. PyMC logs the warning in the main process, in whichever process the chain ran.
    """
    message = (
        _screen_problem(statistics)
        or _collapse_problem(statistics, remedy)
        or _mobility_problem(statistics, is_noisy=bool(remedy))
        or _growth_problem(growth)
        or _failure_problem(statistics)
    )
    return None if message is None else sampler_warning(message)


def lower_chains_of(chains: Sequence[Draws], tune: int) -> list[LowerChain]:
    """Find the chains that stayed far below the highest one after the warm-up."""
    log_densities = {
        i: draws.numbers[tune:, LOG_DENSITY]
        for i, draws in enumerate(chains)
        if len(draws.positions) > tune
    }
    return lower_chains(log_densities, chains[0].positions.shape[1])


def _lower_chain_warning(chain: LowerChain) -> SamplerWarning:
    return sampler_warning(
        f"{str(chain).capitalize()}: it may be in a lower mode, or not have found the posterior. "
        "Start it there (initvals, psf.find_starts) or tune longer."
    )


def sampler_warning(message: str) -> SamplerWarning:
    """Make a warning for PyMC's logger."""
    return SamplerWarning(WarningType.BAD_ACCEPTANCE, message, "warn")


def _screen_problem(statistics: PhaseStatistics) -> str | None:
    failed, screened = statistics.screen_failed, statistics.screened
    if failed <= TOLERATED_FAILURES * screened:
        return None
    return (
        f"The screen failed in {failed} of {screened} proposals after warm-up, which were rejected "
        "without evaluating the target: if the posterior extends into that region it is truncated "
        "there. Use another screen, or none; a lower screen_power does not help."
    )


def _mobility_problem(statistics: PhaseStatistics, *, is_noisy: bool) -> str | None:
    n, screened = statistics.iterations, statistics.screened
    if statistics.accept_rate < MIN_ACCEPT_RATE:
        remedies = ["tune longer", "start elsewhere (initvals)", "give proposal_cov"]
        remedies += ["give the filter more particles (psf.suggest_particles)"] * is_noisy
        remedies += ["lower screen_power"] * bool(screened)
        return (
            f"DRAM accepted {statistics.moved:.0f} of {n} proposals after warm-up: the chain "
            f"hardly moves. One of these may help: {', '.join(remedies)}."
        )
    if statistics.longest_dwell > max(LEAST_DWELL, LONG_DWELL * n):
        begin = "Its"
        if is_noisy:
            begin = (
                "If the estimate there is an overestimate, more particles help "
                "(psf.suggest_particles). Otherwise its"
            )
        return (
            f"DRAM stayed at one point for {statistics.longest_dwell} of {n} draws. {begin} "
            "proposals do not lead away from there: tune longer, start elsewhere (initvals), or "
            "give proposal_cov."
        )
    return None


def _record_warning(target: RecordTarget, statistics: PhaseStatistics) -> SamplerWarning | None:
    """Warn of the record that moved least, or of the parameters that all records decide on."""
    n, rates = statistics.iterations, statistics.by_record
    slow = sorted((rate, g) for g, rate in enumerate(rates) if rate < MIN_ACCEPT_RATE)
    others = f" and {len(slow) - 1} more" if len(slow) > 1 else ""
    if slow:
        rate, g = slow[0]
        return sampler_warning(
            f"Record {target.labels[g]!r}{others} hardly moved: it accepted {rate * n:.0f} of {n} "
            "proposals after warm-up. Tune longer, start elsewhere (initvals), or, if the "
            "likelihood is noisy, give its filter more particles."
        )
    shared = target.structure.shared
    if shared and statistics.shared_rate < MIN_ACCEPT_RATE:
        names = ", ".join(target.variable_name(value) for value in shared)
        return sampler_warning(
            f"The parameters that all records share ({names}) accepted "
            f"{statistics.shared_rate * n:.0f} of {n} proposals after warm-up: the noise of all "
            "records decides on each. Give every record its own, with a distribution of the "
            "population (the centred form), or the filter more particles."
        )
    if statistics.longest_dwell > max(LEAST_DWELL, LONG_DWELL * n):
        return sampler_warning(
            f"Record {target.labels[statistics.slowest or 0]!r} stayed at one point for "
            f"{statistics.longest_dwell} of {n} draws. If the likelihood is noisy, its estimate "
            "there is an overestimate: give its filter more particles. Otherwise tune longer, or "
            "start elsewhere (initvals)."
        )
    return None


def _growth_problem(growth: Growth | None) -> str | None:
    if growth is None or growth.factor <= TOLERATED_GROWTH:
        return None
    return (
        f"The proposals of {growth.name} have become {growth.factor:.2g} times wider than its "
        "prior's draws (under a flat prior: than 1). If data and prior leave it undetermined, its "
        "draws diverge and are meaningless: give it a proper prior. If it is only large, start "
        "near it (initvals) and give proposal_cov."
    )


def _collapse_problem(statistics: PhaseStatistics, remedy: str) -> str | None:
    if statistics.collapsed > TOLERATED_COLLAPSES * statistics.iterations:
        return (
            f"In {statistics.collapsed} of {statistics.iterations} draws the particles collapsed: "
            f"fewer than {COLLAPSED:g} of them determined the estimated likelihood at some "
            "observation (sample_stats n_effective; filter_diagnostics shows at which). A chain is "
            f"slow to leave an overestimate. {remedy}".rstrip()
        )
    return None


def _failure_problem(statistics: PhaseStatistics) -> str | None:
    n_failed = sum(count for _, count in statistics.failures)
    if n_failed > TOLERATED_FAILURES * statistics.evaluations:
        cures = filter(None, [Failure.of(code).cure for code, _ in statistics.failures])
        counted = "; ".join(
            f"{Failure.of(code).message} ({count})" for code, count in statistics.failures
        )
        return (
            f"{n_failed} of {statistics.evaluations} evaluations after warm-up failed and were "
            f"rejected: {counted}. If the posterior extends into that region it is truncated there."
            f"{''.join(f' {cure}.' for cure in cures)}"
        )
    return None


def chain_warnings(
    target: Target | RecordTarget, results: Sequence[tuple[Draws, ChainState]], tune: int
) -> list[SamplerWarning]:
    """Warnings about single chains, at most one for each."""
    lower = {low.chain: low for low in lower_chains_of([draws for draws, _ in results], tune)}
    warnings = []
    for i, (draws, state) in enumerate(results):
        statistics = PhaseStatistics.from_draws(draws, tune, len(draws.positions))
        if statistics.iterations:
            growth = target.growth(state)
            warning = closing_warning(statistics, growth, target.collapse_remedy)
            if isinstance(target, RecordTarget):
                warning = _record_warning(target, statistics) or warning
            if warning is not None:
                warnings.append(replace(warning, message=f"Chain {i}: {warning.message}"))
            elif i in lower:
                warnings.append(_lower_chain_warning(lower[i]))
    return warnings
