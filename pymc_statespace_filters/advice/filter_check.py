"""The check of a model's filters at the end of a calculation, with a small part of its time."""

from typing import NamedTuple

from xarray import DataTree

from ..checks.filters.checks import MORE_POINTS, check_at_end, doubts, store, stored
from ..checks.filters.filter_facts import FilterOutcomes, UsedFilters
from ..checks.filters.finding import EXACT, OFF, UNDECIDED
from ..errors import StateSpaceFiltersError
from ..evidence.evidence_facts import CorrectingFilter, FiltersOfDraws
from ..parallel.shared_rows import by_first_rank
from ..parallel.signals import unless_interrupted
from ..pymc_model.inspection import observes_state_space
from ..pymc_model.posterior_draws import MIN_DRAWS
from ..sampling.output.facts import EndedRun
from .words import log, sentences, told, warn_of_filters

# Runs of fewer iterations are trials.
_LEAST_ITERATIONS = 600


class FilterCheck(NamedTuple):
    """Sentences about filters that are not off, for the report, and about those that are."""

    said: tuple[str, ...] = ()
    warned: tuple[str, ...] = ()

    def tell(self, level: str, begin: str = "") -> None:
        """Log the first at this level, and warn of the others."""
        log([begin + text for text in self.said], level)
        warn_of_filters([begin + text for text in self.warned])


@sentences.register
def _(fact: FilterOutcomes) -> list[str]:
    return doubts(fact.outcomes)


@sentences.register
def _(fact: FiltersOfDraws) -> list[str]:
    return stored(fact.idata, fact.model, OFF)


@sentences.register
def _(fact: CorrectingFilter) -> list[str]:
    given = fact.draws, fact.model, fact.filter, fact.seconds, fact.rng, MORE_POINTS
    outcomes = by_first_rank(lambda: check_at_end(*given))
    if isinstance(fact.draws, DataTree):
        store(fact.draws, outcomes)
    return doubts(outcomes)


@told.register
def _(fact: UsedFilters, begin: str) -> list[str]:
    found = check_filters(fact)
    found.tell(fact.level, begin)
    return list(found.warned)


def filters_of(fact: EndedRun) -> FilterCheck:
    """The check at the end of chains, unless the user wants none."""
    is_wanted = fact.options.compute_convergence_checks and fact.options.checks_filters
    if not is_wanted or "posterior" not in fact.tree:
        return FilterCheck()
    n_iterations = fact.request.tune + fact.length.n_iterations
    of_run = n_iterations, fact.seconds, fact.rngs[1], None, fact.options.level
    return check_filters(UsedFilters(fact.tree, fact.model, *of_run))


def check_filters(fact: UsedFilters) -> FilterCheck:
    """Check filters at draws; the outcome is stored with these. Nothing after Ctrl-C."""
    return unless_interrupted(lambda: _check(fact), FilterCheck())


def _check(fact: UsedFilters) -> FilterCheck:
    tree, n_draws = fact.tree, fact.tree["posterior"].sizes["draw"]
    is_trial = n_draws < MIN_DRAWS or fact.n_iterations < _LEAST_ITERATIONS
    if is_trial or not observes_state_space(fact.model):
        return FilterCheck()
    try:
        outcomes = check_at_end(tree, fact.model, fact.filter, fact.seconds, fact.rng)
    except StateSpaceFiltersError as error:
        return FilterCheck((f"The filter was not checked: {error}",))
    store(tree, outcomes)
    longer = {UNDECIDED: "; psf.check_filter(idata, model) takes longer and may decide"}
    said = [
        f"{name}: {one['verdict']}{longer.get(one['outcome'], '')}"
        for name, one in outcomes.items()
        if one["outcome"] not in (OFF, EXACT)  # of an exact one nothing was compared
    ]
    return FilterCheck(tuple(said), tuple(doubts(outcomes)))
