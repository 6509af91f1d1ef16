"""Where the next row of a record lies: its step, and the inputs of the steps that lead there."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..errors import ModelError
from ..system.checks import check_finite, check_floats, is_integer
from ..system.input_columns import columns_between, resets_at
from ..system.labels import columns_in_order
from ..system.model import StateSpaceModel
from ..system.steps import GRID_TOLERANCE, MOST_STEPS, too_many_steps
from ..system.time_axis import TimeAxis
from .filter_steps import InputRows

Array = NDArray[np.float64]


class Place(NamedTuple):
    """A row's step and time, and the length of the steps that lead there."""

    step: int
    time: float
    length: float
    is_on_grid: bool  # and all rows before


class RowSteps:
    """The steps of a record whose rows come one by one; ``is_on_grid`` tells of all so far.

    ``step`` and ``time`` are those of the last row, -1 and ``t0`` before the first, and ``resets``
    are the accumulators that start anew after it.
    """

    def __init__(
        self,
        system: StateSpaceModel,
        t0: float,
        step: int,
        time: float,
        resets: Array,
        *,
        is_on_grid: bool,
    ) -> None:
        self._system, self.is_on_grid = system, is_on_grid
        self._t0, self.step, self.time, self.resets = t0, step, time, resets

    def system_of(self, is_on_grid: bool) -> StateSpaceModel:
        """The user's system; off the grid, with steps of any length."""
        return self._system if is_on_grid else self._system.at_any_times

    def place(self, step: int | None, time: float | None) -> Place:
        """The step and time of a row, and the length of the steps that lead there."""
        if (step is None) == (time is None):
            raise ModelError("give exactly one of step and time")
        dt, last, is_on_grid = self._system.dt, self.step, self.is_on_grid
        if step is not None:
            if not is_on_grid:
                raise ModelError("step must be None: the rows so far have times off the grid")
            if not is_integer(step) or step <= last:
                raise _not_later("step", step, last)
            return _checked(Place(int(step), self._t0 + int(step) * dt, dt, True))
        time = check_finite("time", time)
        if time < self.time or (time == self.time and last >= 0):
            raise _not_later("time", time, self.time)
        number = (time - self._t0) / dt
        if is_on_grid and abs(number - round(number)) <= GRID_TOLERANCE:
            if round(number) <= last:
                raise _not_later("time", time, self.time)
            return _checked(Place(round(number), time, dt, True))
        if (reason := self._system.why_one_length) is not None:
            raise ModelError(
                f"time must be t0 + k * {dt:g}, as {reason}, got {time}: choose a dt of which all "
                "times are multiples"
            )
        gap = time - self.time
        n_steps = max(math.ceil(gap / dt - GRID_TOLERANCE), 1) if gap > 0.0 else 0
        return _checked(Place(max(last, 0) + n_steps, time, gap / max(n_steps, 1), False))

    def rows(self, place: Place, inputs: Any) -> InputRows | None:
        """The rows of inputs of the steps since the last row, of all columns; None without any."""
        system, first = self.system_of(place.is_on_grid), max(self.step, 0)
        if not system.n_input_columns and inputs is None:
            return None
        n_steps = place.step - first
        needed = n_steps + int(system.observation_uses_inputs)
        own = _inputs_of_user(system, inputs, needed)
        starts = lengths = None
        if not place.is_on_grid:
            own = np.concatenate([own, own[-1:]] if len(own) == n_steps > 0 else [own])
            own = own if len(own) else np.zeros((1, system.n_inputs))
            starts = self.time + np.arange(len(own)) * place.length
            lengths = np.append(np.full(len(own) - 1, place.length), 0.0)
        axis = TimeAxis(np.array([place.step]), self._t0, system.dt, starts, lengths)
        return InputRows(first, columns_between(system, own, first, axis, self.resets))

    def passed(self, place: Place, datum: Array | None) -> None:
        """Stand behind a row (p,); None: at its place, where no row is."""
        self.step, self.time, self.is_on_grid = place.step, place.time, place.is_on_grid
        if self._system.accumulators:
            self.resets = np.zeros(len(self._system.accumulators))
            if datum is not None:
                self.resets = resets_at(self._system, datum)


def numbers_of_row(name: str, value: Any, components: Sequence[str], role: str) -> Array:
    """The numbers of a row, NaN where missing, in the order of the components if it has labels."""
    if isinstance(value, pd.Series) and len(components) > 1:
        value = value.to_frame().T
    return check_floats(name, columns_in_order(name, value, components, role), None, missing=True)


def _checked(place: Place) -> Place:
    if place.step > MOST_STEPS:
        raise too_many_steps(place.step)
    return place


def _inputs_of_user(system: StateSpaceModel, inputs: Any, needed: int) -> Array:
    """Inputs (needed, n_inputs): a row for each step, or one for all."""
    if not system.n_inputs and inputs is not None:
        raise ModelError("inputs must be None for a system without inputs")
    if needed == 0 or not system.n_inputs:
        return np.zeros((needed, system.n_inputs))
    if inputs is None:
        raise ModelError(f"inputs must have values of {list(system.inputs)}, got None")
    rows = numbers_of_row("inputs", inputs, system.inputs, "inputs")
    if rows.ndim < 2:
        rows = rows.reshape(-1, 1) if system.n_inputs == 1 else rows.reshape(1, -1)
    if rows.ndim != 2 or rows.shape[1] != system.n_inputs or len(rows) not in (1, needed):
        raise ModelError(
            f"inputs must have shape {(needed, system.n_inputs)}, a row for each step since the "
            f"last row of observations, or one row for all, got {np.shape(inputs)}"
        )
    if not np.isfinite(rows).all():
        raise ModelError("inputs must be finite")
    return np.broadcast_to(rows, (needed, system.n_inputs))


def _not_later(name: str, value: Any, last: Any) -> ModelError:
    if name == "step" and (last < 0 or not is_integer(value)):
        return ModelError(f"step must be an integer from 0 on, got {value!r}")
    return ModelError(f"{name} must be later than the last one, {last}, got {value!r}")
