"""The paragraph about a run that is logged at its end."""

import math
from collections.abc import Mapping, Sequence

from pymc.stats.convergence import SamplerWarning

from ...filters.outcomes import Failure
from ...lower_chains import LowerChain
from ...progress import MIN_ACCEPT_RATE
from .convergence import MAX_RHAT, Convergence
from .datatree import most_iterations
from .warnings import PhaseStatistics, sampler_warning

# Effective draws of each chain below which PyMC takes neither diagnostic for reliable.
_ENOUGH_PER_CHAIN = 100


def closing_report(
    statistics: Mapping[int, PhaseStatistics],
    tune: int,
    lower: Sequence[LowerChain],
    found: Convergence | None,
    names: Sequence[str],
    until_ess: float | None,
) -> str:
    """Describe a run in one paragraph, with what to do about it.

    ``statistics`` are those after the warm-up, by chain, ``names`` those of the elements of a
    position. ``found`` is None if convergence was not asked for, or there are too few draws.
    """
    sentences = [
        _size(statistics, tune, found, names),
        _acceptance(statistics),
        _failures(statistics),
        *(f"{str(chain).capitalize()}." for chain in lower),
        _advice(statistics, lower, found, until_ess),
    ]
    return " ".join(sentence for sentence in sentences if sentence)


def until_ess_warning(
    until_ess: float, draws: int, found: Convergence | None, names: Sequence[str]
) -> SamplerWarning:
    """Warn that chains ended at ``max_draws`` before they had reached ``until_ess``."""
    reached = "" if found is None else f"; {found.described(names)}"
    return sampler_warning(
        f"until_ess={until_ess:g} was not reached with max_draws={draws} draws in each chain: it "
        f"asks for that bulk effective sample size and R-hat of at most {MAX_RHAT} for every "
        f"parameter{reached}. Give a larger max_draws, or make the chains mix better."
    )


def left_out_warnings(lengths: Sequence[int], skipped: int) -> list[SamplerWarning]:
    """Warn of the chains that the result of an interrupted run lacks.

    ``lengths`` are the iterations of each chain, of which the first ``skipped`` are not kept.
    """
    kept, length = most_iterations([n - skipped for n in lengths])
    if length <= 0 or len(kept) == len(lengths):
        return []
    left_out = [
        f"chain {i} had made {n} iterations" if n else f"chain {i} had not begun"
        for i, n in enumerate(lengths)
        if i not in kept
    ]
    return [
        sampler_warning(
            f"The run was interrupted: the result has {len(kept)} of {len(lengths)} chains, with "
            f"{length} iterations of each. It lacks the others: {', '.join(left_out)}."
        )
    ]


def no_draws_warning(name: str) -> SamplerWarning:
    """Warn of a model that the results of an interrupted run lack."""
    return sampler_warning(
        f"The run was interrupted before the chains of model {name!r} had made a draw: the results "
        "lack this model."
    )


def _size(
    statistics: Mapping[int, PhaseStatistics],
    tune: int,
    found: Convergence | None,
    names: Sequence[str],
) -> str:
    lengths = sorted({chain.iterations for chain in statistics.values()})
    chains = "1 chain" if len(statistics) == 1 else f"{len(statistics)} chains"
    draws = " to ".join(str(length) for length in dict.fromkeys((lengths[0], lengths[-1])))
    found_text = "" if found is None else f"; {found.described(names)}"
    return f"{chains} of {draws} draws after a warm-up of {tune}{found_text}."


def _acceptance(statistics: Mapping[int, PhaseStatistics]) -> str:
    rates = {i: chain.accept_rate for i, chain in statistics.items()}
    ends = dict.fromkeys(_percent(rate) for rate in (min(rates.values()), max(rates.values())))
    few = [
        f" Chain {i} accepted one in only {_percent(rate)} % of its iterations."
        for i, rate in rates.items()
        if rate < MIN_ACCEPT_RATE
    ]
    text = f"The chains accepted a proposal in {' to '.join(ends)} % of their iterations."
    if by_record := [rate for chain in statistics.values() for rate in chain.by_record]:
        text = _acceptance_of_blocks(list(statistics.values()), by_record)
    return text + "".join(few)


def _acceptance_of_blocks(statistics: Sequence[PhaseStatistics], by_record: Sequence[float]) -> str:
    """Acceptance of records that are moved one by one, and of what they share."""
    parts = {
        "the records": by_record,
        "the shared parameters": [chain.shared_rate for chain in statistics],
        "the population": [chain.population_rate for chain in statistics],
    }
    ranges = [
        f"{name} {' to '.join(dict.fromkeys((_percent(min(rates)), _percent(max(rates)))))} %"
        for name, rates in parts.items()
        if max(rates) > 0.0
    ]
    return f"Of their proposals were accepted: {', '.join(ranges)}."


def _failures(statistics: Mapping[int, PhaseStatistics]) -> str:
    n_evaluations = sum(chain.evaluations for chain in statistics.values())
    counts: dict[int, int] = {}
    for chain in statistics.values():
        for code, count in chain.failures:
            counts[code] = counts.get(code, 0) + count
    if not counts:
        return f"None of {n_evaluations} evaluations after the warm-up failed."
    by_count = sorted(counts.items(), key=lambda item: -item[1])
    reasons = "; ".join(f"{Failure.of(code).message} ({count})" for code, count in by_count)
    n_failed = sum(counts.values())
    return (
        f"{n_failed} of {n_evaluations} evaluations after the warm-up "
        f"({_percent(n_failed / n_evaluations)} %) failed and were rejected: {reasons}."
    )


def _advice(
    statistics: Mapping[int, PhaseStatistics],
    lower: Sequence[LowerChain],
    found: Convergence | None,
    until_ess: float | None,
) -> str:
    if lower:
        return (
            "These draws are not from one distribution: start the chains in the posterior "
            "(initvals=psf.find_starts()), or tune longer."
        )
    if min(chain.accept_rate for chain in statistics.values()) < MIN_ACCEPT_RATE:
        return "The warnings about single chains say what may help."
    if found is None:
        return ""
    enough = until_ess or _ENOUGH_PER_CHAIN * len(statistics)
    if found.reaches(enough):
        return "Nothing in these numbers speaks against the draws."
    how = f"until_ess={enough:g} does" if until_ess is None else "with a larger max_draws"
    factor = max(2, math.ceil(enough / max(found.ess.min(), 1.0)))
    return (
        f"Draw about {factor} times as many ({how}); if R-hat stays above {MAX_RHAT}, tune longer "
        "or start elsewhere (psf.find_starts)."
    )


def _percent(fraction: float) -> str:
    """A fraction in percent, with a decimal if it is small."""
    return f"{100.0 * fraction:.{1 if fraction < 0.0995 else 0}f}"
