"""Statistics of a phase of a chain, and the warnings about chains when they have ended."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from pymc.stats.convergence import SamplerWarning, WarningType

from ...filters.outcomes import COLLAPSED, Failure
from ...lower_chains import TOLERATED, LowerChain, lower_chains
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
    n_accepted,
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


# Causes that explain why chains have not mixed.
STANDSTILL, LOWER = "standstill", "lower"


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


class Problem(NamedTuple):
    """What went wrong in a chain, and the message about it."""

    cause: str
    message: str


def closing_warning(
    statistics: PhaseStatistics, growth: Growth | None = None, remedy: str = ""
) -> SamplerWarning | None:
    """Warn of what went wrong after warm-up, if anything did; arguments as of `closing_problem`.

    PyMC logs the warning in the main process, in whichever process the chain ran.
    """
    problem = closing_problem(statistics, growth, remedy)
    return None if problem is None else sampler_warning(problem.message)


def closing_problem(
    statistics: PhaseStatistics, growth: Growth | None = None, remedy: str = ""
) -> Problem | None:
    """The first thing that went wrong after warm-up, if anything did.

    ``growth`` is that of the adapted proposals, ``remedy`` what the model's filters can do about
    collapse.
    """
    messages = {
        "screen": _screen_problem(statistics),
        "collapse": _collapse_problem(statistics, remedy),
        STANDSTILL: _mobility_problem(statistics, is_noisy=bool(remedy)),
        "growth": _growth_problem(growth),
        "failures": _failure_problem(statistics),
    }
    found = (Problem(cause, text) for cause, text in messages.items() if text is not None)
    return next(found, None)


def lower_chains_of(chains: Sequence[Draws], tune: int) -> list[LowerChain]:
    """Find the chains that stayed far below the highest one after the warm-up."""
    log_densities = {
        i: draws.numbers[tune:, LOG_DENSITY]
        for i, draws in enumerate(chains)
        if len(draws.positions) > tune
    }
    return lower_chains(log_densities, chains[0].positions.shape[1])


def below_known(known: float, chains: Sequence[Draws], tune: int) -> float | None:
    """By how many nats all chains stayed below a known level; None if they did not.

    All levels are medians of log-densities: a few points may lie high and hold no mass, as in the
    neck of a funnel.
    """
    levels = [
        float(np.median(draws.numbers[tune:, LOG_DENSITY]))
        for draws in chains
        if len(draws.positions) > tune
    ]
    if not levels or not math.isfinite(known):
        return None
    nats = known - max(levels)
    return nats if nats > TOLERATED + chains[0].positions.shape[1] else None


def of_model(name: str) -> str:
    """The beginning of a message about one of several models, which have names."""
    return f"Model {name!r}: " if name else ""


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
    if n < LEAST_DWELL:
        return None
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
            f"DRAM stayed at one point for {statistics.longest_dwell} of {n} iterations. {begin} "
            "proposals from there were not accepted: tune longer, start elsewhere (initvals), or "
            "give proposal_cov."
        )
    return None


def _record_problem(target: RecordTarget, statistics: PhaseStatistics) -> Problem | None:
    """What is wrong with the record that moved least, or with what all records decide on."""
    n, rates, is_noisy = statistics.iterations, statistics.by_record, bool(target.n_noisy)
    slow = sorted((rate, g) for g, rate in enumerate(rates) if rate < MIN_ACCEPT_RATE)
    others = f" and {len(slow) - 1} more" if len(slow) > 1 else ""
    particles = ", or give its filter more particles" if is_noisy else ""
    if slow:
        rate, g = slow[0]
        return Problem(
            STANDSTILL,
            f"Record {target.labels[g]!r}{others} hardly moved: it accepted {rate * n:.0f} of {n} "
            f"proposals after warm-up. Tune longer, start elsewhere (initvals){particles}.",
        )
    shared = target.structure.shared
    if shared and statistics.shared_rate < MIN_ACCEPT_RATE:
        names = ", ".join(target.variable_name(value) for value in shared)
        because, more = "", "tune longer"
        if is_noisy:
            because, more = ": the noise of all records decides on each", "give more particles"
        return Problem(
            STANDSTILL,
            f"The parameters that all records share ({names}) accepted "
            f"{statistics.shared_rate * n:.0f} of {n} proposals after warm-up{because}. Give every "
            "record its own, with a distribution of the population (the centred form), or "
            f"{more}.",
        )
    if statistics.longest_dwell > max(LEAST_DWELL, LONG_DWELL * n):
        remedy = "Tune longer, or start elsewhere (initvals)."
        if is_noisy:
            remedy = "If its estimate there is too high, give its filter more particles. " + remedy
        return Problem(
            STANDSTILL,
            f"Record {target.labels[statistics.slowest or 0]!r} stayed at one point for "
            f"{statistics.longest_dwell} of {n} iterations. {remedy}",
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
    target: Target | RecordTarget,
    results: Sequence[tuple[Draws, ChainState]],
    tune: int,
    thin: int,
) -> dict[str, SamplerWarning]:
    """Warnings about single chains, by their cause: one for all chains that have it."""
    lower = {low.chain: low for low in lower_chains_of([draws for draws, _ in results], tune)}
    by_cause: dict[str, dict[int, str]] = {}
    for i, (draws, state) in enumerate(results):
        statistics = PhaseStatistics.from_draws(draws, tune, len(draws.positions), thin)
        problem = _problem_of(target, state, statistics) if statistics.iterations else None
        if problem is not None:
            by_cause.setdefault(problem.cause, {})[i] = problem.message
        elif i in lower:
            by_cause.setdefault(LOWER, {})[i] = ""
    found = {cause: sampler_warning(_of_chains(texts)) for cause, texts in by_cause.items()}
    if LOWER in by_cause:
        text = _lower_text([lower[i] for i in by_cause[LOWER]])
        found[LOWER] = sampler_warning(text)
    return found


def _problem_of(
    target: Target | RecordTarget, state: ChainState, statistics: PhaseStatistics
) -> Problem | None:
    problem = closing_problem(statistics, target.growth(state), target.collapse_remedy)
    if isinstance(target, RecordTarget):
        return _record_problem(target, statistics) or problem
    return problem


def _of_chains(texts: Mapping[int, str]) -> str:
    """The message of the first chain, for all of them."""
    first, *_ = texts.values()
    if len(texts) == 1:
        return f"Chain {next(iter(texts))}: {first}"
    numbers = "" if len(set(texts.values())) == 1 else f" (The numbers are of chain {min(texts)}.)"
    return f"Chains {listed(texts)}: {first}{numbers}"


def listed(chains: Iterable[int]) -> str:
    """Numbers of chains in words: 0, 2 and 3."""
    *firsts, last = map(str, chains)
    return f"{', '.join(firsts)} and {last}" if firsts else last


def _lower_text(lower: Sequence[LowerChain]) -> str:
    if len(lower) == 1:
        begin, they, them = str(lower[0]).capitalize(), "it may", "it"
    else:
        nats = sorted(low.nats for low in lower)
        begin = (
            f"Chains {listed(low.chain for low in lower)} stayed {nats[0]:.0f} to {nats[-1]:.0f} "
            f"nats below chain {lower[0].highest} (median log-density)"
        )
        they, them = "they may", "them"
    return (
        f"{begin}: {they} be in a lower mode, or not have found the posterior. Start {them} there "
        "(initvals, psf.find_starts) or tune longer."
    )
