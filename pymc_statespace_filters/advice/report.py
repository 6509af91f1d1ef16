"""The paragraph about a run of DRAM that is logged at its end."""

from collections.abc import Sequence

from ..filters.outcomes import Failure
from ..sampling.output.facts import EndedDram
from ..sampling.output.phase_statistics import PhaseStatistics


def closing_report(fact: EndedDram) -> str:
    """Describe a run in one paragraph; what is wrong with it, warnings say."""
    statistics = [chain.statistics for chain in fact.chains.values()]
    return " ".join([_size(fact, statistics), _acceptance(statistics), _failures(statistics)])


def _size(fact: EndedDram, statistics: Sequence[PhaseStatistics]) -> str:
    thin, found = fact.length.thin, fact.convergence
    lengths = sorted({chain.iterations // thin for chain in statistics})
    chains = "1 chain" if len(statistics) == 1 else f"{len(statistics)} chains"
    draws = " to ".join(str(length) for length in dict.fromkeys((lengths[0], lengths[-1])))
    found_text = "" if found is None else f"; {found.described(fact.names)}"
    behind = "" if thin == 1 else f", each the last of {thin} iterations,"
    return f"{chains} of {draws} draws{behind} after a warm-up of {fact.request.tune}{found_text}."


def _acceptance(statistics: Sequence[PhaseStatistics]) -> str:
    rates = [chain.accept_rate for chain in statistics]
    ends = dict.fromkeys(_percent(rate) for rate in (min(rates), max(rates)))
    text = f"The chains accepted a proposal in {' to '.join(ends)} % of their iterations."
    if by_record := [rate for chain in statistics for rate in chain.by_record]:
        text = _acceptance_of_blocks(statistics, by_record)
    return text


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


def _failures(statistics: Sequence[PhaseStatistics]) -> str:
    n_evaluations = sum(chain.evaluations for chain in statistics)
    counts: dict[int, int] = {}
    for chain in statistics:
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


def _percent(fraction: float) -> str:
    """A fraction in percent, with a decimal if it is small."""
    return f"{100.0 * fraction:.{1 if fraction < 0.0995 else 0}f}"
