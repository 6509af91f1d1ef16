"""The warning that a filter failed, or that too few particles decided its terms."""

import warnings
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.errors import FilterWarning, ModelError
from pymc_statespace_filters.filters.grid import GridFilter
from pymc_statespace_filters.filters.guided_pf import GuidedPF
from pymc_statespace_filters.filters.outcomes import COLLAPSED, FAILURES
from pymc_statespace_filters.filters.protocol import HealthFilter
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.diagnostics import TermHealth
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.system.model import StateSpaceModel

type Arguments = tuple[Any, ...]

_MOST_LISTED = 8  # observations


def warn_about(
    system: StateSpaceModel,
    filter: Any,
    health: np.ndarray,
    arguments_of: Callable[[int], Arguments],
    *,
    stacklevel: int = 3,
) -> None:
    """Warn once of failures and once of collapse in some evaluations, given their health (n, 3).

    ``arguments_of(i)`` are the inputs (theta, steps, observed, inputs, t0, seed) of evaluation i,
    which is repeated if its particles were the fewest.
    """
    failed = health[:, 1] != 0
    if failed.any():
        reasons = Counter(FAILURES[int(code)] for code in health[failed, 1])
        listed = "; ".join(f"{count} times {reason}" for reason, count in reasons.most_common())
        warnings.warn(
            f"{filter} gave -inf in {failed.sum()} of {len(health)} evaluations: {listed}",
            FilterWarning,
            stacklevel=stacklevel,
        )
    smallest = np.where(failed, np.inf, health[:, 0])
    collapsed = smallest < COLLAPSED
    if collapsed.any():
        worst = int(np.argmin(smallest))
        warnings.warn(
            f"{filter}: fewer than {COLLAPSED:g} particles decided some terms of the "
            f"log-likelihood in {collapsed.sum()} of {len(health)} evaluations (smallest effective "
            f"number {smallest[worst]:.3g}). {_extent(system, filter, arguments_of(worst))}, by a "
            f"different amount for every seed; more particles lessen this only slowly. "
            f"{_remedy(system, filter)}",
            FilterWarning,
            stacklevel=stacklevel,
        )


def _remedy(system: StateSpaceModel, filter: Any) -> str:
    """Say which filter gives the likelihood of a system without collapse."""
    if _exact_filter(system) is not None:
        return "Use GridFilter(), which computes this likelihood without particles."
    if isinstance(filter, GuidedPF):
        return "Use more particles; if they collapse again, BootstrapPF(n) with many."
    return (
        "Use GuidedPF(n), which is unbiased and moves its particles to where the record leads; if "
        "they collapse there, too, BootstrapPF(n) with many."
    )


def _extent(system: StateSpaceModel, filter: Any, arguments: Arguments) -> str:
    """Say which terms few particles decided, and by how much they fall short if that is known."""
    unknown = "The log-likelihood may be tens of nats too low"
    if not isinstance(filter, HealthFilter):
        return unknown
    terms, n_effective, _ = evaluator(TermHealth(system, filter))(*arguments)
    few = np.flatnonzero(n_effective < COLLAPSED)
    listed = ", ".join(map(str, few[:_MOST_LISTED])) + ", .." * (few.size > _MOST_LISTED)
    where = f"In the worst of them these are {few.size} of {terms.size} terms, j = {listed}"
    exact = _exact_filter(system)
    if exact is None:
        return f"{where}. {unknown}"
    missing = evaluator(LogLikelihood(system, exact))(*arguments)[0] - terms
    if not np.isfinite(missing).all():
        return f"{where}. {unknown}"
    return (
        f"{where}, together {_below(missing[few].sum())} those of {exact}; the log-likelihood is "
        f"{_below(missing.sum())}"
    )


def _below(missing: float) -> str:
    return f"{abs(missing):.1f} nats {'below' if missing > 0 else 'above'}"


def _exact_filter(system: StateSpaceModel) -> GridFilter | None:
    exact = GridFilter()
    try:
        exact.check(compile_system(system))
    except ModelError:
        return None
    return exact if exact.is_exact_for(compile_system(system)) else None
