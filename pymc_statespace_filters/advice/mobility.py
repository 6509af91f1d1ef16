"""What went wrong in single chains: they stand still, run away, fail, or are lower than others."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from ..filters.outcomes import COLLAPSED, Failure
from ..sampling.output.chain_bars import MIN_ACCEPT_RATE
from ..sampling.output.convergence import MAX_RHAT
from ..sampling.output.facts import EndedChain, EndedDram
from ..sampling.output.phase_statistics import PhaseStatistics
from ..sampling.target.record_target import RecordTarget
from ..sampling.target.sampled_model import Growth
from ..statistics.lower_chains import LowerChain
from ..tables import joined
from .collapse import collapse_remedies
from .words import sentences

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
STANDSTILL, LOWER, GROWTH = "standstill", "lower", "growth"


class Problem(NamedTuple):
    """What went wrong in a chain, and the message about it."""

    cause: str
    message: str


@sentences.register
def _(fact: EndedChain) -> list[str]:
    """The first thing that went wrong after warm-up, if anything did."""
    problem = _problem(fact)
    return [] if problem is None else [problem.message]


def chain_problems(fact: EndedDram) -> dict[str, str]:
    """What is wrong with single chains, by its cause: one message for all chains that have it."""
    lower = {low.chain: low for low in fact.lower}
    by_cause: dict[str, dict[int, str]] = {}
    found = fact.convergence
    is_mixed = found is not None and found.rhat.max() <= MAX_RHAT
    for i, chain in fact.chains.items():
        # Chains that agree do not spread without end: a scale is large.
        problem = _problem(replace(chain, growth=None) if is_mixed else chain)
        if problem is not None:
            by_cause.setdefault(problem.cause, {})[i] = problem.message
        elif i in lower:
            by_cause.setdefault(LOWER, {})[i] = ""
    texts = {cause: _of_chains(of_cause) for cause, of_cause in by_cause.items()}
    if LOWER in by_cause:
        texts[LOWER] = _lower_text([lower[i] for i in by_cause[LOWER]])
    return texts


def _problem(chain: EndedChain) -> Problem | None:
    statistics = chain.statistics
    if isinstance(chain.target, RecordTarget):
        of_records = _record_problem(chain.target, statistics)
        if of_records is not None:
            return of_records
    remedy = collapse_remedies(chain.target.model)
    messages = {
        "screen": _screen_problem(statistics),
        "collapse": _collapse_problem(statistics, remedy),
        STANDSTILL: _mobility_problem(statistics, is_noisy=bool(remedy)),
        GROWTH: _growth_problem(chain.growth),
        "failures": _failure_problem(statistics),
    }
    found = (Problem(cause, text) for cause, text in messages.items() if text is not None)
    return next(found, None)


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


def _of_chains(texts: Mapping[int, str]) -> str:
    """The message of the first chain, for all of them."""
    first, *_ = texts.values()
    if len(texts) == 1:
        return f"Chain {next(iter(texts))}: {first}"
    numbers = "" if len(set(texts.values())) == 1 else f" (The numbers are of chain {min(texts)}.)"
    return f"Chains {joined(map(str, texts))}: {first}{numbers}"


def _lower_text(lower: Sequence[LowerChain]) -> str:
    if len(lower) == 1:
        begin, they, them = str(lower[0]).capitalize(), "it may", "it"
    else:
        nats = sorted(low.nats for low in lower)
        begin = (
            f"Chains {joined(str(low.chain) for low in lower)} stayed {nats[0]:.0f} to "
            f"{nats[-1]:.0f} nats below chain {lower[0].highest} (median log-density)"
        )
        they, them = "they may", "them"
    return (
        f"{begin}: {they} be in a lower mode, or not have found the posterior. Start {them} there "
        "(initvals, psf.find_starts) or tune longer."
    )
