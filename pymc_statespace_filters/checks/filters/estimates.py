"""Estimates of the likelihood at the points of a check, by the model's filter and by witnesses.

The witnesses are filters whose estimate is unbiased or exact. Plain particles know nothing of what
a guided filter assumes; both are unbiased, and only where both agree is a difference from them
trusted that does not follow from unbiasedness alone.
"""

import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from ...compiler.lowering.compiled_system import compile_system
from ...filters.bootstrap import BootstrapPF
from ...filters.catalog import exact_filter, filters_for
from ...filters.guided_pf import GuidedPF
from ...filters.protocol import Filter
from ...filters.rbpf import RBPF
from ...pymc_model.filter_estimates import VariableAtPoints
from ...pymc_model.inspection import resized
from .budget import Budget

Array = NDArray[np.float64]

_ONE_SEED = np.zeros((1, 1), dtype=np.int64)
N_SEEDS, N_GUIDED_SEEDS = 6, 8  # of noisy filters at each point; guided ones take less time
_AT_ONCE, _FEWEST = 2, 4  # points, after which the time is looked at, and at least
# CPU seconds of an evaluation with which an exact filter suits a chain, and is the only witness.
_QUICK = 0.01
_MORE = 4  # times as many particles has the second guided witness
# Standard deviation of the logs of estimates, in nats, above which their mean is not trusted.
USABLE = 2.0


class Estimates(NamedTuple):
    """Logs of estimates by one filter, (m, r): one column if it has no noise."""

    filter: Filter
    logs: Array

    @property
    def mean(self) -> Array:
        """The log of the mean over seeds, (m,)."""
        return np.asarray(logsumexp(self.logs, axis=1) - np.log(self.logs.shape[1]))

    @property
    def error(self) -> Array:
        """The standard error of `mean` (m,), by that of the mean of the estimates."""
        n = self.logs.shape[1]
        if n == 1:
            return np.zeros(len(self.logs))
        with np.errstate(invalid="ignore"):
            ratios = np.exp(self.logs - self.mean[:, None])
        return ratios.std(axis=1, ddof=1) / np.sqrt(n)

    @property
    def typical_error(self) -> float:
        """The median of the standard errors; infinite where all estimates failed."""
        known = self.error[np.isfinite(self.error)]
        return float(np.median(known)) if known.size else np.inf

    @property
    def scatter(self) -> float:
        """The standard deviation of the logs over seeds, in the median of the points."""
        if self.logs.shape[1] == 1:
            return 0.0 if np.isfinite(self.logs).all() else np.inf
        finite = np.isfinite(self.logs).all(axis=1)
        if 2 * finite.sum() <= len(self.logs):
            return np.inf
        return float(np.median(np.sqrt(self.logs[finite].var(axis=1, ddof=1))))

    @property
    def is_usable(self) -> bool:
        """Whether the log of the mean is close to the log-likelihood."""
        return self.scatter <= USABLE

    def at(self, rows: NDArray[np.bool_]) -> "Estimates":
        """Those of some of the points."""
        return Estimates(self.filter, self.logs[rows])


class Comparison(NamedTuple):
    """The filter that is checked and its witnesses at the first points, as far as time allowed."""

    checked: Estimates
    exact: Estimates | None
    plain: Estimates | None
    guided: tuple[Estimates, ...]

    @property
    def unbiased(self) -> tuple[Estimates, ...]:
        """The witnesses with noise."""
        return (*((self.plain,) if self.plain else ()), *self.guided)

    @property
    def of_witnesses(self) -> Array:
        """The highest log-likelihood by a witness at each point, (m,)."""
        witnesses = [*self.unbiased, *([self.exact] if self.exact else [])]
        failed = np.full(len(self.checked.logs), -np.inf)
        return np.max([failed, *(one.mean for one in witnesses)], axis=0)

    def at(self, rows: NDArray[np.bool_]) -> "Comparison":
        """The same at some of the points."""
        return Comparison(
            self.checked.at(rows),
            None if self.exact is None else self.exact.at(rows),
            None if self.plain is None else self.plain.at(rows),
            tuple(one.at(rows) for one in self.guided),
        )


def compare(
    variable: VariableAtPoints, filter: Filter, budget: Budget, rng: np.random.Generator
) -> Comparison:
    """Evaluate the filter and its witnesses, point by point until the budget is spent."""
    filters = [filter, *_witnesses(variable, filter, budget)]
    for one in filters:
        _seconds(variable, one)  # compiled before the time counts
    budget.begin()
    found: list[list[Array]] = [[] for _ in filters]
    scored = not is_unbiased(filter)
    for first in range(0, len(variable), _AT_ONCE):
        points = range(first, min(first + _AT_ONCE, len(variable)))
        for one, logs in zip(filters, found, strict=True):
            seeds = rng.integers(2**62, size=(len(points), _n_seeds(one)))
            logs.append(variable.at(points, one, seeds, scored=scored))
        budget.on_progress(len(points))
        if budget.is_spent and points.stop >= _FEWEST:
            break
    estimates = [Estimates(f, np.concatenate(logs)) for f, logs in zip(filters, found, strict=True)]
    checked, *others = estimates
    return Comparison(
        checked,
        next((one for one in others if not one.filter.noisy), None),
        next((one for one in others if isinstance(one.filter, BootstrapPF | RBPF)), None),
        tuple(one for one in others if isinstance(one.filter, GuidedPF)),
    )


def _n_seeds(filter: Filter) -> int:
    if not filter.noisy:
        return 1
    return N_GUIDED_SEEDS if isinstance(filter, GuidedPF) else N_SEEDS


def _witnesses(variable: VariableAtPoints, filter: Filter, budget: Budget) -> list[Filter]:
    """A filter without noise or bias that is quick; else unbiased ones, and it if there is time."""
    exact = exact_filter(compile_system(variable.system), without=filter)
    if exact is None or not np.isfinite(variable.at([0], exact, _ONE_SEED)).all():
        return unbiased_witnesses(variable, filter, budget)
    seconds = _seconds(variable, exact)
    if seconds <= _QUICK:
        return [exact]
    found = unbiased_witnesses(variable, filter, budget)
    return [exact, *found] if budget.is_enough_for(seconds * len(variable)) else found


def _seconds(variable: VariableAtPoints, filter: Filter) -> float:
    """CPU seconds of an evaluation at the first point."""
    began = time.process_time()
    variable.at([0], filter, _ONE_SEED)
    return time.process_time() - began


def is_unbiased(filter: Filter) -> bool:
    """Whether a filter with noise is known to be unbiased."""
    return filter.noisy and bool(getattr(filter, "unbiased", False))


def unbiased_witnesses(variable: VariableAtPoints, filter: Filter, budget: Budget) -> list[Filter]:
    """Plain particles, and guided ones if there is time and no equation jumps, which misleads them.

    Of a guided filter, the same with more particles. Plain are those with Kalman filters where they
    are unbiased, which scatter far less.
    """
    system = compile_system(variable.system)
    n_points, n_steps = len(variable), variable.n_steps
    n_particles = budget.n_particles(N_SEEDS * n_points, n_steps, system.n)
    taken = filters_for(system)
    regimes: list[Filter] = [
        one for one in taken if isinstance(one, RBPF) and one.is_exact_for(system)
    ]
    plain: list[Filter] = [one for one in taken if isinstance(one, BootstrapPF)]
    if regimes and not isinstance(filter, RBPF):
        plain = regimes
    found: list[Filter] = [resized(one, n_particles) for one in plain]
    guided = [one for one in taken if isinstance(one, GuidedPF) and not system.jumping_equations]
    if variable.leaves_rows_out and not is_unbiased(filter):
        guided = []  # of a part of a record its estimate is wrong
    if isinstance(filter, GuidedPF):
        guided = [replace(filter, n_particles=_MORE * filter.n_particles)]
    n_estimates = N_GUIDED_SEEDS * n_points
    affordable = (
        one for one in guided if budget.affords(one.n_particles, n_estimates, n_steps, system.n)
    )
    return [*found, *affordable]
