"""Inputs with times of their own, as rows of inputs for the steps of a record."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..errors import ModelError
from .checks import check_floats
from .clock import Clock
from .labels import columns_in_order
from .steps import GRID_TOLERANCE
from .time_axis import TimeAxis, check_increasing

INPUTS_AT = ("hold", "linear")


class TimedInputs(NamedTuple):
    """Values (R, n_inputs) from ``times`` (R,) on, or linear between them; see `INPUTS_AT`."""

    times: np.ndarray
    values: np.ndarray
    rule: str

    def changes(self) -> np.ndarray:
        """The times at which held inputs change."""
        if self.rule == "linear":
            return np.empty(0)
        return self.times[1:][(np.diff(self.values, axis=0) != 0).any(axis=1)]

    def rows(self, axis: TimeAxis, clock: Clock, record: int = 0) -> np.ndarray:
        """A row for each step up to the last observation, and the one that follows it."""
        starts, lengths = axis.rows()
        if starts[0] < self.times[0] - GRID_TOLERANCE * axis.dt:
            begin, first = clock.shown([starts[0], self.times[0]], record)
            raise ModelError(
                f"input_times must begin at or before the first step, at {begin}, got {first}"
            )
        if self.rule == "hold":
            at = np.searchsorted(self.times, starts + GRID_TOLERANCE * axis.dt, side="right") - 1
            return self.values[at]
        middles = starts + lengths / 2
        middles[-1] = starts[-1]
        if middles[-1] > self.times[-1] + GRID_TOLERANCE * axis.dt:
            end, last = clock.shown([middles[-1], self.times[-1]], record)
            raise ModelError(
                f"input_times must reach the last observation, at {end}, with "
                f"inputs_at='linear', got {last}"
            )
        columns = [np.interp(middles, self.times, column) for column in self.values.T]
        return np.stack(columns, axis=1)


def timed_inputs(
    inputs: Any,
    input_times: Any,
    inputs_at: Any,
    names: Sequence[str],
    clock: Clock,
    record: int = 0,
) -> TimedInputs:
    """Check inputs of these names with times of their own."""
    check_inputs_at(inputs_at)
    times = clock.numbers("input_times", input_times, record)
    check_increasing("input_times", times, lambda time: clock.shown(time, record))
    values = check_floats("inputs", columns_in_order("inputs", inputs, names, "inputs"), None)
    if values.ndim == 1 and len(names) == 1:
        values = values[:, None]
    if not names or values.shape != (times.size, len(names)):
        raise ModelError(
            f"inputs must have shape {(times.size, len(names))}, a row for each of input_times and "
            f"a column for each input of the system, got {np.shape(inputs)}"
        )
    return TimedInputs(times, values, inputs_at)


def check_inputs_at(inputs_at: Any) -> None:
    """Raise unless ``inputs_at`` is one of `INPUTS_AT`."""
    if not isinstance(inputs_at, str) or inputs_at not in INPUTS_AT:
        raise ModelError(f"inputs_at must be one of {list(INPUTS_AT)}, got {inputs_at!r}")
