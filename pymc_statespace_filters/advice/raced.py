"""How a race of samplers went, in a sentence."""

from ..sampling.output.facts import EndedNuts, EndedRun, Raced
from ..sampling.run.stopping import expected_iterations
from .mixing import rounded
from .words import log, sentences, told


@sentences.register
def _(fact: Raced) -> list[str]:
    return ["; ".join(f"{_name(run, fact)} {_outcome(run, fact)}" for run in fact.runs)]


@told.register
def _(fact: Raced, begin: str) -> list[str]:
    said = [f"{begin}{text}." for text in sentences(fact)]
    log(said, fact.best.level)
    return said


def _name(run: EndedRun, fact: Raced) -> str:
    if isinstance(run, EndedNuts):
        return "NUTS, from its points,"
    return "DRAM" if run is fact.runs[0] else "DRAM, from the better points,"


def _outcome(run: EndedRun, fact: Raced) -> str:
    found, n = run.convergence, run.length.n_iterations
    if isinstance(run, EndedNuts) and run.is_beaten:
        return "would take more evaluations"
    if isinstance(run, EndedNuts) and run.diverges:
        return f"diverged in {run.diverging.mean():.1%} of its draws"
    if run is fact.runs[0] and run is not fact.best:
        needed = rounded(expected_iterations(run.request, run.length, found))
        return f"would take some {needed} iterations of each chain for draws worth {fact.goal:g}"
    worth = 0.0 if found is None else found.least_ess
    return f"made draws worth {worth:.0f} with {n} iterations of each chain"
