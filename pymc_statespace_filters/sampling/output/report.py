"""The paragraph about a run that is logged at its end."""

from collections.abc import Callable, Mapping, Sequence

from pymc.stats.convergence import SamplerWarning

from ...filters.outcomes import Failure
from .convergence import MAX_RHAT, Convergence
from .datatree import most_iterations
from .remedies import alternatives
from .warnings import PhaseStatistics, sampler_warning

# Effective draws of each chain below which PyMC takes neither diagnostic for reliable.
ENOUGH_PER_CHAIN = 100


def closing_report(
    statistics: Mapping[int, PhaseStatistics],
    tune: int,
    found: Convergence | None,
    names: Sequence[str],
    thin: int,
) -> str:
    """Describe a run in one paragraph; what is wrong with it, warnings say.

    ``statistics`` are those after the warm-up, by chain, ``names`` those of the elements of a
    position. ``found`` is None if convergence was not asked for, or there are too few draws.
    """
    sentences = [
        _size(statistics, tune, thin, found, names),
        _acceptance(statistics),
        _failures(statistics),
    ]
    return " ".join(sentence for sentence in sentences if sentence)


def mixing_warning(
    found: Convergence | None,
    names: Sequence[str],
    enough: float,
    n_iterations: int,
    seconds: float,
    ways: Callable[[str], Sequence[str]],
) -> SamplerWarning | None:
    """Warn of chains that disagree, or whose draws are worth too little, with what would do.

    ``ways`` gives what works for the model if an element with this name is slow.
    """
    if found is None:
        return sampler_warning("The number of draws is too small to check convergence.")
    if found.reaches(enough):
        return None
    text = f"The chains have not mixed: {found.described(names)}. "
    if found.least_ess < enough:
        text += f"{needed(found, enough, n_iterations, seconds)} (until_ess={enough:g} does it). "
    if found.rhat.max() > MAX_RHAT:
        remedy = alternatives(ways(names[int(found.rhat.argmax())]))
        text += f"If R-hat stays above {MAX_RHAT}, {remedy}."
    return sampler_warning(text.strip())


def few_draws_warning(found: Convergence, names: Sequence[str], n_draws: int) -> SamplerWarning:
    """Warn that the draws of a run that went on until they are nearly independent are few."""
    return sampler_warning(
        f"{n_draws} draws in all are too few to be sure that the chains have mixed: "
        f"{found.described(names)}. Give more draws."
    )


def needed(found: Convergence, enough: float, n_iterations: int, seconds: float) -> str:
    """How many iterations would do, and what they take."""
    factor = max(1.0, enough / max(found.least_ess, 1.0))
    return (
        f"About {rounded(factor * n_iterations)} iterations of each chain would do, in "
        f"{duration(factor * seconds)}"
    )


def below_known_warning(nats: float) -> SamplerWarning:
    """Warn of chains far below the points that the search for starts has found."""
    return sampler_warning(
        f"The chains never reached the posterior: their median log-density stayed {nats:.0f} nats "
        "or more below that of the points which the search for starts has found. Tune longer, or "
        "start there (initvals=psf.find_starts())."
    )


def until_ess_warning(
    until_ess: float,
    n_iterations: int,
    seconds: float,
    found: Convergence | None,
    names: Sequence[str],
    remedy: str,
) -> SamplerWarning:
    """Warn that chains have ended before they had reached ``until_ess``, with what to do."""
    reached = "" if found is None else f": {found.described(names)}"
    return sampler_warning(
        f"until_ess={until_ess:g} was not reached with {n_iterations} iterations of each chain in "
        f"{duration(seconds)}{reached}. {remedy[0].upper()}{remedy[1:]}."
    )


def rounded(number: float) -> str:
    """A number with two digits, without an exponent."""
    return f"{float(f'{number:.1e}'):.0f}"


def duration(seconds: float) -> str:
    """Seconds in words, roughly."""
    if seconds < 0.95:
        return "less than a second"
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    minutes = seconds / 60.0
    return f"{minutes:.0f} min" if minutes < 100.0 else f"{minutes / 60.0:.0f} h"


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
        f"The run was interrupted before model {name!r} had a draw: the results lack this model."
    )


def _size(
    statistics: Mapping[int, PhaseStatistics],
    tune: int,
    thin: int,
    found: Convergence | None,
    names: Sequence[str],
) -> str:
    lengths = sorted({chain.iterations // thin for chain in statistics.values()})
    chains = "1 chain" if len(statistics) == 1 else f"{len(statistics)} chains"
    draws = " to ".join(str(length) for length in dict.fromkeys((lengths[0], lengths[-1])))
    found_text = "" if found is None else f"; {found.described(names)}"
    behind = "" if thin == 1 else f", each the last of {thin} iterations,"
    return f"{chains} of {draws} draws{behind} after a warm-up of {tune}{found_text}."


def _acceptance(statistics: Mapping[int, PhaseStatistics]) -> str:
    rates = {i: chain.accept_rate for i, chain in statistics.items()}
    ends = dict.fromkeys(_percent(rate) for rate in (min(rates.values()), max(rates.values())))
    text = f"The chains accepted a proposal in {' to '.join(ends)} % of their iterations."
    if by_record := [rate for chain in statistics.values() for rate in chain.by_record]:
        text = _acceptance_of_blocks(list(statistics.values()), by_record)
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


def _percent(fraction: float) -> str:
    """A fraction in percent, with a decimal if it is small."""
    return f"{100.0 * fraction:.{1 if fraction < 0.0995 else 0}f}"
