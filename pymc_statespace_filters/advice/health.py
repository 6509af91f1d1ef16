"""Evaluations that failed, or that few particles decided: where, how far off, what helps."""

from typing import Any

import numpy as np

from ..compiler.lowering.compiled_system import compile_system
from ..evaluation.health import Arguments, Health
from ..filters.catalog import exact_filter
from ..filters.outcomes import COLLAPSED, Failure
from ..filters.written import short_form
from ..ops.base import evaluator
from ..ops.likelihood import LogLikelihood
from ..ops.states import TermHealth
from ..system.input_columns import times_of_steps
from ..system.model import StateSpaceModel
from ..system.parameters import element_names
from ..system.readers import counts
from .collapse import collapse_remedy, elsewhere
from .words import sentences

_MOST_LISTED = 8  # observations, or records
_NEGLIGIBLE = 0.01  # nats
_N_SEEDS = 5  # at which a collapsed estimate is repeated, to say how noisy it is


@sentences.register
def _(fact: Health) -> list[str]:
    """One sentence for each kind of failure, and one of collapse."""
    found = [_failure(fact, code) for code in np.unique(fact.health[fact.failed, 1])]
    collapse = _collapse(fact)
    return found if collapse is None else [*found, collapse]


def _failure(fact: Health, code: float) -> str:
    system, filter, health = fact.system, fact.filter, fact.health
    failure, here = Failure.of(code), health[:, 1] == code
    first = int(np.argmax(here))
    share = f" in {here.sum()} of {len(health)} evaluations" if len(health) > 1 else ""
    arguments = fact.arguments_of(first)
    place = _place(system, failure, health[first, 2], arguments, bool(share))
    sentences = (
        f"{short_form(filter)} gave -inf{share}{_named(fact, here)}{place}: {failure.message}",
        *_cures(system, filter, failure, arguments, health[first, 2]),
    )
    return f"{'. '.join(sentences)}."


def _collapse(fact: Health) -> str | None:
    """Say which evaluations few particles decided; the one with fewest is repeated for it."""
    system, filter, smallest = fact.system, fact.filter, fact.smallest
    collapsed, worst = smallest < COLLAPSED, int(np.argmin(smallest))
    extent = _extent(system, filter, fact.arguments_of(worst)) if collapsed.any() else None
    if extent is None:
        return None
    sentences = (
        f"{short_form(filter)}: fewer than {COLLAPSED:g} particles decided some terms of the "
        f"log-likelihood in {collapsed.sum()} of {len(smallest)} evaluations"
        f"{_named(fact, collapsed)} (smallest effective number {smallest[worst]:.3g})",
        *_about_copies(system, filter),
        extent,
        collapse_remedy(compile_system(system), filter),
    )
    return ". ".join(sentences)


def _about_copies(system: StateSpaceModel, filter: Any) -> list[str]:
    """Why particles that are copies of one are counted as one, where they are."""
    undriven = compile_system(system).undriven_states
    if not (undriven and getattr(filter, "counts_copies", False)):
        return []
    states = f"the state{'s' * (len(undriven) > 1)} {', '.join(undriven)}"
    return [f"Copies of a particle count as one: no noise reaches {states}"]


def _place(
    system: StateSpaceModel, failure: Failure, row: float, arguments: Arguments, of_many: bool
) -> str:
    """Where an evaluation failed, the first of many: its row and time, and its parameters."""
    theta, steps, _, inputs, t0, *_ = arguments
    first, parts = ", first" if of_many else "", []
    if failure.has_row:
        time = times_of_steps(system, inputs, steps[int(row)], t0)
        parts.append(f" in row {int(row)}, at time {time:.6g}")
    if of_many and 0 < theta.size <= _MOST_LISTED:
        named = zip(element_names(system), theta, strict=True)
        parts.append(f" with {', '.join(f'{name} = {value:.4g}' for name, value in named)}")
    return first + ",".join(parts) if parts else ""


def _cures(
    system: StateSpaceModel, filter: Any, failure: Failure, arguments: Arguments, row: float
) -> list[str]:
    """What to do, for this system where that depends on it.

    Another filter is no cure of what lies in the equations or their parameters.
    """
    compiled = compile_system(system)
    if failure == Failure.STATE_NOT_FINITE and not system.has_gaussian_steps:
        return [
            "In process_dist a rate below 0, a probability above 1 or a size that is not a whole "
            "number is drawn as NaN"
        ]
    if failure == Failure.STATE_NOT_FINITE and (outside := _outside(system, arguments[0])):
        return [outside]
    if failure == Failure.ZERO_DENSITY and (fraction := _fraction(system, arguments[2][int(row)])):
        return [fraction]
    cures = [failure.cure] if failure.cure else []
    if failure == Failure.ZERO_DENSITY and filter.noisy and not compiled.is_deterministic:
        exact = exact_filter(compiled, without=filter)
        if exact is None or np.isfinite(_terms(system, exact, arguments)).all():
            cures.append(elsewhere(compiled, filter).removesuffix("."))
    return cures


def _fraction(system: StateSpaceModel, datum: np.ndarray) -> str | None:
    """Say that an observation (p,) has a fraction where it is a count; None if it has none."""
    for name, value, is_count in zip(system.observables, datum, counts(system), strict=True):
        if is_count and value != np.round(value) and not np.isnan(value):
            return f"{name} = {value:.6g} is no whole number, and its distribution is of counts"
    return None


def _outside(system: StateSpaceModel, theta: np.ndarray) -> str | None:
    """Say that a drifting parameter starts where its scale has no number; None if none does."""
    values = dict(zip(element_names(system), theta, strict=True))
    for one in system.drifting:
        if not one.link.contains(value := values[one.name]):
            return (
                f"The drifting {one.name} starts at {value:.4g}, outside its scale "
                f"{one.process.scale!r}: give it a prior on this scale, or another scale"
            )
    return None


def _terms(system: StateSpaceModel, filter: Any, arguments: Arguments) -> np.ndarray:
    return np.asarray(evaluator(LogLikelihood(system, filter))(*arguments)[0])


def _named(fact: Health, chosen: np.ndarray) -> str:
    """The records of the chosen evaluations."""
    if fact.labels is None:
        return ""
    of_each = np.arange(len(fact.health)) // (len(fact.health) // len(fact.labels))
    found = [fact.labels[number] for number in np.unique(of_each[chosen])]
    listed = ", ".join(map(repr, found[:_MOST_LISTED])) + ", .." * (len(found) > _MOST_LISTED)
    return f", of {'record' if len(found) == 1 else 'records'} {listed}"


def _extent(system: StateSpaceModel, filter: Any, arguments: Arguments) -> str | None:
    """Say which terms few particles decided, and how far off or how noisy their sum is.

    None if they decided no term, or the sum is right for every seed, as that of a guided filter
    of a linear system.
    """
    terms, n_effective, _ = evaluator(TermHealth(system, filter))(*arguments)
    few = np.flatnonzero(n_effective < COLLAPSED)
    if few.size == 0:
        return None
    listed = ", ".join(map(str, few[:_MOST_LISTED])) + ", .." * (few.size > _MOST_LISTED)
    where = f"In the worst of them these are {few.size} of {terms.size} terms, j = {listed}"
    exact = exact_filter(compile_system(system), without=filter)
    if exact is not None:
        missing = _terms(system, exact, arguments) - terms
        if abs(missing.sum()) < _NEGLIGIBLE:
            estimates = _at_other_seeds(system, filter, arguments, terms.sum())
            if estimates.size == _N_SEEDS and np.ptp(estimates) < _NEGLIGIBLE:
                return None
        if np.isfinite(missing).all():
            return (
                f"{where}, together {_below(missing[few].sum())} those of {short_form(exact)}; the "
                f"log-likelihood is {_below(missing.sum())}, by a different amount for every seed"
            )
    estimates = _at_other_seeds(system, filter, arguments, terms.sum())
    n_failed, spread = _N_SEEDS - estimates.size, float(np.ptp(estimates))
    if spread < _NEGLIGIBLE and not n_failed:
        return where
    failed = f" and was -inf at {n_failed} of them" if n_failed else ""
    return (
        f"{where}; at {_N_SEEDS} seeds the log-likelihood ranged over {_nats(spread)}"
        f"{failed}, and it is too low more often than not"
    )


def _at_other_seeds(
    system: StateSpaceModel, filter: Any, arguments: Arguments, first: float
) -> np.ndarray:
    """The finite estimates of the log-likelihood at a seed, ``first``, and at some others."""
    *record, seed = arguments
    seeds = [int(seed) ^ other for other in range(1, _N_SEEDS)]
    others = [_terms(system, filter, (*record, each)).sum() for each in seeds]
    return np.array([value for value in (first, *others) if np.isfinite(value)])


def _below(missing: float) -> str:
    return f"{_nats(abs(missing))} {'below' if missing > 0 else 'above'}"


def _nats(size: float) -> str:
    if size < 0.1:
        return "less than 0.1 nats"
    return f"{size:.1f} nats" if size < 1000.0 else f"{size:.0f} nats"
