"""Estimates of the likelihood at the points of a check, by the model's filter and by witnesses.

The witnesses are filters whose estimate is unbiased or exact. Plain particles know nothing of what
a guided filter assumes. Guided ones take no more than a hundred particles where sensors are precise
and records long; they run some unguided particles along the record, and where these find what the
guide leaves out their estimates scatter. Those that do not scatter are right: of 183 records with
sensors that fold, bend or have kinks the worst were two nats off.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...compiler.lowering.compiled_system import compile_system
from ...filters.bootstrap import BootstrapPF
from ...filters.catalog import exact_filter, filters_for
from ...filters.guided_pf import GuidedPF
from ...filters.protocol import Filter
from ...filters.rbpf import RBPF
from ...pymc_model.filter_estimates import VariableAtPoints
from ...pymc_model.inspection import resized
from ...statistics.importance import log_sum
from .budget import Budget

Array = NDArray[np.float64]

_ONE_SEED = np.zeros((1, 1), dtype=np.int64)
_N_SEEDS = 6  # of noisy filters at each point
_N_GUIDED_SEEDS = 2  # of guided witnesses of an approximation, trusted where they hardly scatter
_AT_ONCE, _FEWEST = 2, 4  # points, after which the time is looked at, and at least
_QUICK = 0.02  # CPU seconds of an evaluation with which an exact filter suits a chain
# CPU seconds in which the loops of a filter are compiled, once per installation.
_COMPILED_IN, _PLAIN_COMPILED_IN = 20.0, 5.0
_MORE = 4  # times as many particles has the guided witness of a guided filter
# Standard deviation of the logs of estimates, in nats, above which their mean is not trusted.
USABLE = 2.0


class Estimates(NamedTuple):
    """Logs of estimates by one filter, (m, r): one column if it has no noise."""

    filter: Filter
    logs: Array

    @property
    def mean(self) -> Array:
        """The log of the mean over seeds, (m,)."""
        return np.asarray(log_sum(self.logs, axis=1) - np.log(self.logs.shape[1]))

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
    """The filter that is checked and its witnesses, at the same points."""

    checked: Estimates
    witnesses: tuple[Estimates, ...] = ()

    @property
    def exact(self) -> Estimates | None:
        """Those of a filter without noise."""
        return next((one for one in self.witnesses if not one.filter.noisy), None)

    @property
    def unbiased(self) -> tuple[Estimates, ...]:
        """Those of filters with noise."""
        return tuple(one for one in self.witnesses if one.filter.noisy)

    @property
    def plain(self) -> Estimates | None:
        """Those of particles without a guide."""
        return next((one for one in self.unbiased if not isinstance(one.filter, GuidedPF)), None)

    @property
    def guided(self) -> Estimates | None:
        """Those of particles with one."""
        return next((one for one in self.unbiased if isinstance(one.filter, GuidedPF)), None)

    @property
    def of_witnesses(self) -> Array:
        """The highest log-likelihood by a witness at each point, (m,)."""
        return np.asarray(np.max([one.mean for one in self.witnesses], axis=0))

    @property
    def highest(self) -> Array:
        """The same by any filter."""
        return np.asarray(np.maximum(self.checked.mean, self.of_witnesses))

    def at(self, rows: NDArray[np.bool_]) -> "Comparison":
        """The same at some of the points."""
        return Comparison(self.checked.at(rows), tuple(one.at(rows) for one in self.witnesses))

    def with_witness(self, one: Estimates) -> "Comparison":
        """The same with another witness, at the first points if it has no more."""
        rows = np.arange(len(self.checked.logs)) < len(one.logs)
        found = self.at(rows)
        return found._replace(witnesses=(*found.witnesses, one.at(rows[rows])))

    def joined(self, other: "Comparison") -> "Comparison":
        """These points and others, by the same filters."""
        pairs = zip((self.checked, *self.witnesses), (other.checked, *other.witnesses), strict=True)
        checked, *witnesses = (
            Estimates(one.filter, np.concatenate([one.logs, more.logs])) for one, more in pairs
        )
        return Comparison(checked, tuple(witnesses))


def compare(
    variable: VariableAtPoints,
    filters: Sequence[Filter],
    budget: Budget,
    rng: np.random.Generator,
    *,
    scored: bool,
) -> Comparison:
    """Evaluate a filter and its witnesses, point by point until the budget is spent.

    Without ``scored`` the terms of all rows count, see `VariableAtPoints.at`.
    """
    found: list[list[Array]] = [[] for _ in filters]
    for first in range(0, len(variable), _AT_ONCE):
        points = range(first, min(first + _AT_ONCE, len(variable)))
        for one, logs in zip(filters, found, strict=True):
            is_quiet = scored and isinstance(one, GuidedPF)
            n_seeds = _N_GUIDED_SEEDS if is_quiet else _N_SEEDS if one.noisy else 1
            seeds = rng.integers(2**62, size=(len(points), n_seeds))
            logs.append(variable.at(points, one, seeds, scored=scored))
        budget.on_progress(len(points))
        if budget.is_spent and points.stop >= _FEWEST:
            break
    checked, *others = (
        Estimates(f, np.concatenate(logs)) for f, logs in zip(filters, found, strict=True)
    )
    return Comparison(checked, tuple(others))


def is_unbiased(filter: Filter) -> bool:
    """Whether a filter with noise is known to be unbiased."""
    return filter.noisy and bool(getattr(filter, "unbiased", False))


def witnesses(variable: VariableAtPoints, filter: Filter, budget: Budget) -> Iterator[Filter]:
    """Filters to compare with, compiled, the one that tells most first, while there is time.

    One of them at most is compiled where compilation takes a part of the budget.
    """
    may_compile = True
    for one in _candidates(variable, filter, budget):
        if budget.counts_compilation and not variable.is_compiled(one):
            seconds = _PLAIN_COMPILED_IN if isinstance(one, BootstrapPF) else _COMPILED_IN
            if not (may_compile and budget.allows(seconds)):
                continue
            may_compile = False
        with budget.compiling():
            at_first = variable.at([0], one, _ONE_SEED)
        if one.noisy or (np.isfinite(at_first).all() and _seconds(variable, one) <= _QUICK):
            yield one


def _seconds(variable: VariableAtPoints, filter: Filter) -> float:
    """CPU seconds of an evaluation at the first point."""
    began = time.process_time()
    variable.at([0], filter, _ONE_SEED)
    return time.process_time() - began


def _candidates(variable: VariableAtPoints, filter: Filter, budget: Budget) -> list[Filter]:
    """An exact filter, guided particles and plain ones; of an unbiased filter plain ones first.

    Those with Kalman filters where they are unbiased, which scatter far less than plain ones. No
    guided ones where an equation jumps, which misleads them. Of a guided filter, the same with more
    particles.
    """
    system = compile_system(variable.system)
    exact, taken = exact_filter(system, without=filter), filters_for(system)
    number = budget.n_particles(_N_SEEDS * len(variable), variable.n_steps, system.n)
    kalman = [one for one in taken if isinstance(one, RBPF) and one.is_exact_for(system)]
    others = [one for one in taken if isinstance(one, BootstrapPF)]
    plain = [resized(one, number) for one in kalman or others]
    guided = [one for one in taken if isinstance(one, GuidedPF) and not system.jumping_equations]
    if isinstance(filter, GuidedPF):
        guided = [replace(filter, n_particles=_MORE * filter.n_particles)]
    elif variable.leaves_rows_out and not is_unbiased(filter):
        guided = []  # of a part of a record its estimate is wrong
    noisy: list[Filter] = [*plain, *guided] if is_unbiased(filter) else [*guided, *plain]
    return noisy if exact is None else [exact, *noisy]
