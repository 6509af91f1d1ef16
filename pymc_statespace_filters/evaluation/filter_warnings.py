"""Warnings of filters: failed, decided by too few particles, or chosen against the equations."""

import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..compiler.lowering.compiled_system import compile_system
from ..errors import FilterWarning
from ..filters.outcomes import COLLAPSED, FAILURES, NO_FINITE_MEMBER
from ..filters.protocol import HealthFilter
from ..filters.recommendation import (
    collapse_remedy,
    exact_filter,
    jump_problem,
    repetition_problem,
    short_form,
)
from ..ops.base import evaluator
from ..ops.likelihood import LogLikelihood
from ..ops.states import TermHealth
from ..system.model import StateSpaceModel

type Arguments = tuple[Any, ...]

_MOST_LISTED = 8  # observations, or records
_N_SEEDS = 5  # at which a collapsed estimate is repeated, to say how noisy it is


def warn_about(
    system: StateSpaceModel,
    filter: Any,
    health: np.ndarray,
    arguments_of: Callable[[int], Arguments],
    *,
    labels: Sequence[Any] | None = None,
    stacklevel: int = 3,
) -> None:
    """Warn once of failures and once of collapse in some evaluations, given their health (n, 3).

    ``arguments_of(i)`` are the inputs (theta, steps, observed, inputs, t0, seed) of evaluation i,
    which is repeated if its particles were the fewest. ``labels`` are those of the records of a
    panel; the evaluations of one come before those of the next, and are as many.
    """
    failed = health[:, 1] != 0
    of_each = None if labels is None else np.arange(len(health)) // (len(health) // len(labels))
    if failed.any():
        reasons = Counter(FAILURES[int(code)] for code in health[failed, 1])
        listed = "; ".join(f"{count} times {reason}" for reason, count in reasons.most_common())
        if NO_FINITE_MEMBER in health[failed, 1] and not system.has_gaussian_steps:
            listed += "; in process_dist a rate below 0, a probability above 1 or a size that is "
            listed += "not a whole number is drawn as NaN"
        warnings.warn(
            f"{short_form(filter)} gave -inf in {failed.sum()} of {len(health)} evaluations"
            f"{_named(labels, of_each, failed)}: {listed}",
            FilterWarning,
            stacklevel=stacklevel,
        )
    smallest = np.where(failed, np.inf, health[:, 0])
    collapsed = smallest < COLLAPSED
    if collapsed.any():
        worst = int(np.argmin(smallest))
        warnings.warn(
            f"{short_form(filter)}: fewer than {COLLAPSED:g} particles decided some terms of the "
            f"log-likelihood in {collapsed.sum()} of {len(health)} evaluations"
            f"{_named(labels, of_each, collapsed)} (smallest effective "
            f"number {smallest[worst]:.3g}). {_extent(system, filter, arguments_of(worst))}. "
            f"{collapse_remedy(compile_system(system), filter)}",
            FilterWarning,
            stacklevel=stacklevel,
        )


def _named(labels: Sequence[Any] | None, of_each: Any, chosen: np.ndarray) -> str:
    """The records of the chosen evaluations."""
    if labels is None:
        return ""
    found = [labels[number] for number in np.unique(of_each[chosen])]
    listed = ", ".join(map(repr, found[:_MOST_LISTED])) + ", .." * (len(found) > _MOST_LISTED)
    return f", of {'record' if len(found) == 1 else 'records'} {listed}"


def warn_of_choice(system: StateSpaceModel, filter: Any, *, stacklevel: int = 3) -> None:
    """Warn if the filter linearises an equation that jumps, or repeats a run without noise."""
    compiled = compile_system(system)
    for problem in (jump_problem(compiled, filter), repetition_problem(compiled, filter)):
        if problem is not None:
            warnings.warn(problem, FilterWarning, stacklevel=stacklevel)


def _extent(system: StateSpaceModel, filter: Any, arguments: Arguments) -> str:
    """Say which terms few particles decided, and how far off or how noisy their sum is."""
    if not isinstance(filter, HealthFilter):
        return "The log-likelihood may be far too low, by a different amount for every seed"
    terms, n_effective, _ = evaluator(TermHealth(system, filter))(*arguments)
    few = np.flatnonzero(n_effective < COLLAPSED)
    listed = ", ".join(map(str, few[:_MOST_LISTED])) + ", .." * (few.size > _MOST_LISTED)
    where = f"In the worst of them these are {few.size} of {terms.size} terms, j = {listed}"
    exact = exact_filter(compile_system(system), without=filter)
    if exact is not None:
        missing = evaluator(LogLikelihood(system, exact))(*arguments)[0] - terms
        if np.isfinite(missing).all():
            return (
                f"{where}, together {_below(missing[few].sum())} those of {short_form(exact)}; the "
                f"log-likelihood is {_below(missing.sum())}, by a different amount for every seed"
            )
    estimates = _at_other_seeds(system, filter, arguments, terms.sum())
    n_failed = _N_SEEDS - estimates.size
    failed = f" and was -inf at {n_failed} of them" if n_failed else ""
    return (
        f"{where}; at {_N_SEEDS} seeds the log-likelihood ranged over {np.ptp(estimates):.1f} nats"
        f"{failed}, and it is too low more often than not"
    )


def _at_other_seeds(
    system: StateSpaceModel, filter: Any, arguments: Arguments, first: float
) -> np.ndarray:
    """The finite estimates of the log-likelihood at a seed, ``first``, and at some others."""
    *record, seed = arguments
    evaluate = evaluator(LogLikelihood(system, filter))
    others = [evaluate(*record, int(seed) ^ other)[0].sum() for other in range(1, _N_SEEDS)]
    return np.array([value for value in (first, *others) if np.isfinite(value)])


def _below(missing: float) -> str:
    return f"{abs(missing):.1f} nats {'below' if missing > 0 else 'above'}"
