"""How a race of samplers went, in a sentence."""

from ..sampling.output.facts import EndedNuts, EndedRun, Raced
from ..sampling.run.stopping import expected_iterations
from .mixing import rounded
from .words import log, sentences, told


@sentences.register
def _(fact: Raced) -> list[str]:
    kinds = [isinstance(run, EndedNuts) for run in fact.runs]
    said = []
    for i, run in enumerate(fact.runs):
        # Of walks, each from the points of the one before, the last one is named.
        if run is fact.best or kinds[i] or kinds[i + 1 : i + 2] != [False]:
            name = (
                "DRAM, restarted from the better points,"
                if any(kinds[:i])
                else _first_name(run, fact)
            )
            said.append(f"{name} {_outcome(run, fact)}")
    return ["; ".join(said)]


@told.register
def _(fact: Raced, begin: str) -> list[str]:
    said = [f"{begin}{text}." for text in sentences(fact)]
    log(said, fact.best.options.level)
    return said


def _first_name(run: EndedRun, fact: Raced) -> str:
    """The name of a run before which no NUTS has run."""
    if isinstance(run, EndedNuts):
        return "NUTS, started from its points,"
    return "DRAM" if run is fact.runs[0] else "DRAM, restarted from its own points,"


def _outcome(run: EndedRun, fact: Raced) -> str:
    found, n = run.convergence, run.length.n_iterations
    if isinstance(run, EndedNuts) and run.is_beaten:
        return "would take more evaluations"
    if isinstance(run, EndedNuts) and run is not fact.best and run.diverges:
        return f"diverged in {run.diverging.mean():.1%} of its draws"
    if not isinstance(run, EndedNuts) and run is not fact.best:
        needed = rounded(expected_iterations(run.request, run.length, found))
        return f"needs some {needed} iterations of each chain for {fact.goal:g} effective draws"
    worth = 0.0 if found is None else found.least_ess
    return f"gave {worth:.0f} effective draws in {n} iterations of each chain"
