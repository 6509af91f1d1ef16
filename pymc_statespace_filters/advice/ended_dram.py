"""What is said at the end of a run of DRAM: each cause once, and the report."""

from functools import partial

from ..parallel.signals import is_interrupted
from ..pymc_model.inspection import have_missing_codes
from ..sampling.output.datatree import most_iterations
from ..sampling.output.facts import EndedDram, WithoutDraws
from .collapse import collapse_remedies
from .filter_check import filters_of
from .mirrors import of_one_image
from .missed import missed_of
from .mixing import mixing_problem, until_ess_problem
from .mobility import GROWTH, LOWER, STANDSTILL, chain_problems
from .noise import variance_advice
from .remedies import ways_to_mix
from .report import closing_report
from .words import log, sentences, told


@told.register
def _(fact: EndedDram, begin: str) -> list[str]:
    of_chains = chain_problems(fact)
    said = [*of_chains.values(), *_noise(fact)]
    is_looked_at = fact.options.compute_convergence_checks and "posterior" in fact.tree
    alike = fact
    if is_looked_at and GROWTH not in of_chains:  # draws that mean nothing lack nothing
        missed, alike = missed_of(fact)
        said += missed
    check = filters_of(fact)
    # An estimate may be far too high by chance: the level says nothing of one with noise.
    if fact.below is not None and not fact.target.seed_names:
        said.append(
            "The chains never reached the posterior: their median log-density stayed "
            f"{fact.below:.0f} nats or more below that of the points which the search for starts "
            "has found. Tune longer, or start there (initvals=psf.find_starts())."
        )
    elif fact.chains and of_chains.keys().isdisjoint({STANDSTILL, LOWER, GROWTH}):
        said += of_one_image(_mixing(alike), alike is not fact)
    said += _left_out(fact)
    report = closing_report(fact) if fact.chains else ""
    problems = said or check.warned or is_interrupted() or have_missing_codes(fact.model)
    if report and fact.options.compute_convergence_checks and not problems:
        report += " No problems found."
    log([begin + text for text in said])
    log([begin + report] if report else [], fact.options.level)
    check.tell(fact.options.level, begin)
    return [*said, *check.warned]


@sentences.register
def _(fact: WithoutDraws) -> list[str]:
    if (error := fact.error) is not None:
        kind = type(error).__name__
        return [f"Model {fact.name!r} ended in an error; the results lack it. {kind}: {error}"]
    return [
        f"The run was interrupted before model {fact.name!r} had a draw: the results lack this "
        "model."
    ]


def _noise(fact: EndedDram) -> list[str]:
    """The noise of the likelihood at the highest draw, if it is far outside the best range."""
    if fact.spread is None:
        return []
    chain, spread = fact.spread
    filters, remedy = fact.target.noisy_filters, collapse_remedies(fact.model)
    text = variance_advice(spread, "at its highest draw", chain, filters, remedy)
    return [] if text is None else [text]


def _mixing(fact: EndedDram) -> list[str]:
    """Chains that ended too early, or have not mixed."""
    ways = partial(ways_to_mix, fact.model, fact.names, fact.positions)
    text = until_ess_problem(fact, ways) if fact.is_complete else None
    if text is None and fact.options.compute_convergence_checks:
        text = mixing_problem(fact, ways)
    return [] if text is None else [text]


def _left_out(fact: EndedDram) -> list[str]:
    """The chains that the result of an interrupted run lacks."""
    skipped = fact.request.n_skipped
    kept, length = most_iterations([n - skipped for n in fact.lengths])
    if length <= 0 or len(kept) == len(fact.lengths):
        return []
    left_out = [
        f"chain {i} had made {n} iterations" if n else f"chain {i} had not begun"
        for i, n in enumerate(fact.lengths)
        if i not in kept
    ]
    return [
        f"The run was interrupted: the result has {len(kept)} of {len(fact.lengths)} chains, with "
        f"{length} iterations of each. It lacks the others: {', '.join(left_out)}."
    ]
