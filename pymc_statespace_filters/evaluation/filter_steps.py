"""A filter that stands behind a row and takes the next one: at one point, or at many."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..compiler.lowering.compiled_system import compile_system
from ..filters.protocol import DifferentiableFilter, Filter, properties
from ..ops.base import evaluator, kernel
from ..ops.states import FilterRun, GoingOn
from ..system.model import StateSpaceModel
from ..system.own_units import law_in_own_units, run_in_own_units

Array = NDArray[np.float64]


class InputRows(NamedTuple):
    """Rows of inputs (m, n_input_columns), of which the first is that of this step."""

    first: int
    rows: Array


class Step(NamedTuple):
    """Terms (m,) of a row at m points, failure codes (m,), and mean and covariance of the state.

    ``n_particles`` (m,) are effective numbers of particles behind the terms.
    """

    terms: Array
    codes: Array
    n_particles: Array
    mean: Array
    cov: Array


class FilterSteps(Protocol):
    """A filter at one or more points."""

    @property
    def left(self) -> list[Array]:
        """What the filter has left at each point, behind the last row that was kept."""
        ...

    def __call__(self, step: int, datum: Array, inputs: InputRows | None) -> Step:
        """Take a row (p,) at a step, from where the filter stands."""
        ...

    def keep(self, chosen: NDArray[np.bool_] | None = None) -> None:
        """Stand behind the last row, at the chosen points alone; None: at all."""
        ...


def filter_steps(
    system: StateSpaceModel,
    filter: Filter,
    theta: Array,
    seeds: NDArray[np.int64],
    t0: float,
    left: list[Array],
) -> FilterSteps:
    """The filter of a system at points theta (m, k), each from what it has left there, if it has.

    Before the first row nothing is left: arrays of length 0.
    """
    if (
        len(theta) > 1
        and properties(filter).resumes_many
        and isinstance(filter, DifferentiableFilter)
    ):
        return _SideBySide(system, filter, theta, t0, left)
    points = [
        _Point(system, filter, own, seed, t0, before)
        for own, seed, before in zip(theta, seeds, left, strict=True)
    ]
    return points[0] if len(points) == 1 else _OneByOne(points)


class _Inputs:
    """All rows of inputs so far, at the places of their steps."""

    def __init__(self, n_columns: int) -> None:
        self.rows = np.zeros((0, n_columns))

    def take(self, given: InputRows | None) -> bool:
        """Add rows, and tell whether they have all moved to other memory."""
        if given is None:
            return False
        end, is_moved = given.first + len(given.rows), False
        if end > len(self.rows):
            longer = np.zeros((max(end, 2 * len(self.rows), 64), self.rows.shape[1]))
            longer[: len(self.rows)] = self.rows
            self.rows, is_moved = longer, True
        self.rows[given.first : end] = given.rows
        return is_moved


class _Point:
    """One point, in memory that every row uses again."""

    def __init__(
        self,
        system: StateSpaceModel,
        filter: Filter,
        theta: Array,
        seed: np.int64,
        t0: float,
        before: Array,
    ) -> None:
        self._system, self._filter = system, filter
        self._is_in_own_units = bool(system.drifting)
        self._function = kernel(FilterRun(system, filter)).loaded()
        self._inputs = _Inputs(system.n_input_columns)
        self._step, self._datum = np.zeros(1, dtype=np.int64), np.zeros((1, system.p))
        self._theta = np.require(theta, requirements=("C", "W"))
        self._t0, self._seed = np.asarray(t0), np.asarray(seed)
        self._before = np.array(before)
        self._call: Callable[[], None] | None = None
        self._results: list[Array] = []

    @property
    def left(self) -> list[Array]:
        """What the filter has left behind the last row that was kept."""
        return [self._before.copy()]

    def __call__(self, step: int, datum: Array, inputs: InputRows | None) -> Step:
        """Take a row from where the filter stands."""
        is_moved = self._inputs.take(inputs)
        self._step[0], self._datum[0] = step, datum
        if self._call is None or is_moved:
            self._call = self._bound()
        self._call()
        terms, health, mean, cov, members, weights, left = self._results
        if self._is_in_own_units:
            points = self._filter.law_of_state(compile_system(self._system), left[None]).are_points
            law = mean, cov
            mean, cov, _ = run_in_own_units(self._system, law, members, weights, are_points=points)
        else:
            mean, cov = mean.copy(), cov.copy()
        return Step(terms.copy(), health[1:2].astype(np.int64), health[:1].copy(), mean, cov)

    def keep(self, chosen: NDArray[np.bool_] | None = None) -> None:
        """Stand behind the last row."""
        after = self._results[-1]
        if self._before.size == after.size:
            self._before[:] = after
        else:
            self._before, self._call = after.copy(), None

    def _bound(self) -> Callable[[], None]:
        call, self._results = self._function.repeated(
            self._theta, self._step, self._datum, self._inputs.rows, self._t0, self._seed,
            self._step, self._before,
        )  # fmt: skip
        return call


class _OneByOne:
    """Points each with its own noise, one after the other."""

    def __init__(self, points: list[_Point]) -> None:
        self._points = points

    @property
    def left(self) -> list[Array]:
        """What the filter has left at each point."""
        return [one for point in self._points for one in point.left]

    def __call__(self, step: int, datum: Array, inputs: InputRows | None) -> Step:
        """Take a row at every point."""
        found = [point(step, datum, inputs) for point in self._points]
        return Step(*map(np.concatenate, zip(*found, strict=True)))

    def keep(self, chosen: NDArray[np.bool_] | None = None) -> None:
        """Stand behind the last row at the chosen points."""
        if chosen is not None:
            self._points = [one for one, kept in zip(self._points, chosen, strict=True) if kept]
        for point in self._points:
            point.keep()


class _SideBySide:
    """All points in one call of machine code, of a filter without noise."""

    def __init__(
        self, system: StateSpaceModel, filter: DifferentiableFilter, theta: Array, t0: float,
        left: list[Array],
    ) -> None:  # fmt: skip
        self._system, self._filter = system, filter
        self._evaluate = evaluator(GoingOn(system, filter))
        self._inputs = _Inputs(system.n_input_columns)
        self._theta, self._t0 = np.ascontiguousarray(theta), np.asarray(t0)
        self._before = np.array(left)

    @property
    def left(self) -> list[Array]:
        """What the filter has left at each point."""
        return list(self._before.copy())

    def __call__(self, step: int, datum: Array, inputs: InputRows | None) -> Step:
        """Take a row at every point."""
        self._inputs.take(inputs)
        steps, data = np.array([step]), datum.reshape(1, -1)
        terms, health, self._after = self._evaluate(
            self._theta, steps, data, self._inputs.rows, self._t0, self._before
        )
        law = self._filter.law_of_state(compile_system(self._system), self._after)
        mean, cov = law.moments()
        if self._system.drifting:
            mean, cov = law_in_own_units(self._system, mean, cov)
        return Step(terms[:, 0], health[:, 1].astype(np.int64), health[:, 0], mean, cov)

    def keep(self, chosen: NDArray[np.bool_] | None = None) -> None:
        """Stand behind the last row at the chosen points."""
        kept = slice(None) if chosen is None else chosen
        self._theta, self._before = self._theta[kept], self._after[kept]
