"""Chains that have not mixed, or ended before their draws were worth enough: what would do."""

from collections.abc import Callable, Sequence

from ..pymc_model.prior import can_sample
from ..sampling.output.convergence import MAX_RHAT, Convergence
from ..sampling.output.facts import EndedRun
from ..sampling.run.stopping import ENOUGH, is_enough, shows
from .remedies import alternatives

# Effective draws of each chain below which PyMC takes neither diagnostic for reliable.
ENOUGH_PER_CHAIN = 100

type Ways = Callable[[str], Sequence[str]]
"""What works for the model if an element with this name is slow."""


def mixing_problem(fact: EndedRun, ways: Ways) -> str | None:
    """Say that chains disagree, or that their draws are worth too little; None if not."""
    request, found = fact.request, fact.convergence
    enough = float(ENOUGH_PER_CHAIN * request.chains)
    if found is None:
        return "The number of draws is too small to check convergence."
    if found.reaches(enough):
        return None
    if not shows(request, ENOUGH):  # they were made until they are nearly independent
        return (
            f"{request.chains * request.draws} draws in all are too few to be sure that the chains "
            f"have mixed: {found.described(fact.names)}. Give more draws."
        )
    is_mixed = found.rhat.max() <= MAX_RHAT
    what = "The draws are worth too little" if is_mixed else "The chains have not mixed"
    text = f"{what}: {found.described(fact.names)}. "
    if endless := _endless(fact, found):
        return f"{text}{endless[0].upper()}{endless[1:]}."
    if found.least_ess < enough:
        is_asked = (request.until_ess or 0.0) >= enough  # and the user has ended it
        does_it = "" if is_asked else f" (until_ess={enough:g} does it)"
        text += f"{_needed(fact, found, enough)}{does_it}. "
    if not is_mixed:
        remedy = alternatives(ways(fact.names[int(found.rhat.argmax())]))
        text += f"If R-hat stays above {MAX_RHAT}, {remedy}."
    return text.strip()


def until_ess_problem(fact: EndedRun, ways: Ways, remedy: str = "") -> str | None:
    """Say that chains have ended before they had reached ``until_ess``; None if they had.

    With what to do: the ``remedy``, or more iterations if they would do.
    """
    until_ess, found = fact.request.until_ess, fact.convergence
    if until_ess is None or is_enough(fact.request, found):
        return None
    slowest = fact.names[0 if found is None else int(found.rhat.argmax())]
    remedy = remedy or _remedy(fact, until_ess, ways(slowest))
    reached = "" if found is None else f": {found.described(fact.names)}"
    return (
        f"until_ess={until_ess:g} was not reached with {fact.length.n_iterations} iterations of "
        f"each chain in {_duration(fact.seconds)}{reached}. {remedy[0].upper()}{remedy[1:]}."
    )


def _remedy(fact: EndedRun, enough: float, ways: Sequence[str]) -> str:
    request, length, found = fact.request, fact.length, fact.convergence
    if found is not None and (endless := _endless(fact, found)):
        return endless
    if not shows(request, enough):
        return f"give more draws: {request.chains} * {request.draws} hardly show so many"
    would_do = "" if found is None else f"{_needed(fact, found, enough)}; "
    if not request.doubles_thin:
        return would_do + alternatives(["give a larger max_draws", *ways])
    if 2 * length.n_iterations > (request.max_draws or 0):
        return would_do + alternatives([f"give a larger max_draws than {request.max_draws}", *ways])
    more = "make more with psf.sample(continue_from=idata)"
    if not fact.goes_on:
        more = "draw more with psf.sample(draws=..., until_ess=None), which has no limit of time"
    # A race ends for what its samplers take in all; what chains take is at most their seconds.
    ended = "the run ended as twice as many would take longer than it may: "
    if 2.0 * request.chains * fact.seconds < request.seconds:
        ended = ""
    return f"{would_do}{ended}{alternatives([more, *ways])}"


def _endless(fact: EndedRun, found: Convergence) -> str:
    """That priors without an end may be why chains disagree, and what to do; empty if not."""
    priors = [rv.name for rv in fact.model.free_RVs if not can_sample(rv, fact.model)]
    if not priors or found.rhat.max() <= MAX_RHAT:
        return ""
    return (
        f"the prior of {', '.join(priors)} is improper: what the data leave undetermined spreads "
        "without end, however many iterations there are; give a proper prior"
    )


def _needed(fact: EndedRun, found: Convergence, enough: float) -> str:
    """How many iterations would do, and what they take."""
    factor = max(1.0, enough / max(found.least_ess, 1.0))
    return (
        f"About {rounded(factor * fact.length.n_iterations)} iterations of each chain would do, "
        f"in {_duration(factor * fact.seconds)}"
    )


def rounded(number: float) -> str:
    """A number with two digits, without an exponent."""
    return f"{float(f'{number:.1e}'):.0f}"


def _duration(seconds: float) -> str:
    """Seconds in words, roughly."""
    if seconds < 0.95:
        return "less than a second"
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    minutes = seconds / 60.0
    return f"{minutes:.0f} min" if minutes < 100.0 else f"{minutes / 60.0:.0f} h"
