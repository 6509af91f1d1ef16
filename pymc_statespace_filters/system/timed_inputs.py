"""Inputs with times of their own, as rows of inputs for the steps of a record."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import ModelError
from .clock import Clock, times_of_data
from .labels import table_of
from .model import StateSpaceModel
from .steps import GRID_TOLERANCE
from .time_axis import TimeAxis, check_increasing

INPUTS_AT = ("hold", "linear")


@dataclass(frozen=True, eq=False)  # arrays are not hashable, and a random variable holds this
class TimedInputs:
    """Values (R, n_inputs) from ``times`` (R,) on, or linear between them; see `INPUTS_AT`.

    A step takes a linear input in its middle, or, where the observation at its beginning uses
    inputs, ``at_beginning``.
    """

    times: np.ndarray
    values: np.ndarray
    rule: str
    at_beginning: bool

    def changes(self) -> np.ndarray:
        """The times at which held inputs change."""
        if self.rule == "linear":
            return np.empty(0)
        return self.times[1:][(np.diff(self.values, axis=0) != 0).any(axis=1)]

    def held_on(self) -> "TimedInputs":
        """The same, with a last value that holds for ever."""
        times, values = np.append(self.times, np.inf), np.append(self.values, self.values[-1:], 0)
        return replace(self, times=times, values=values)

    def followed_by(self, later: "TimedInputs") -> "TimedInputs":
        """These inputs up to the first of the later times, and the later ones from there on."""
        if later.rule != self.rule:
            raise ModelError(
                f"inputs_at must be {self.rule!r}, as that of the model, where input_times begin "
                f"after its start, got {later.rule!r}"
            )
        begin = later.times[0]
        earlier = self.times < begin
        times, values = self.times[earlier], self.values[earlier]
        if self.rule == "linear":
            before = np.nextafter(begin, -np.inf)
            last = [np.interp(before, self.times, column) for column in self.values.T]
            times, values = np.append(times, before), np.append(values, [last], 0)
        times, values = np.append(times, later.times), np.append(values, later.values, 0)
        return replace(later, times=times, values=values)

    def rows(self, axis: TimeAxis, clock: Clock, record: int = 0) -> np.ndarray:
        """A row for each step up to the last observation, and the one that follows it."""
        starts, lengths = axis.rows()
        if starts[0] < self.times[0] - GRID_TOLERANCE * axis.dt:
            begin, first = clock.shown([starts[0], self.times[0]], record)
            raise ModelError(
                f"input_times must begin at or before the first step, at {begin}, got {first}"
            )
        if self.rule == "hold":
            last = np.searchsorted(self.times, starts + GRID_TOLERANCE * axis.dt, side="right") - 1
            return self.values[last]
        at = starts if self.at_beginning else starts + lengths / 2
        at[-1] = starts[-1]
        if at[-1] > self.times[-1] + GRID_TOLERANCE * axis.dt:
            end, last = clock.shown([at[-1], self.times[-1]], record)
            raise ModelError(
                f"input_times must reach the last observation, at {end}, with "
                f"inputs_at='linear', got {last}"
            )
        columns = [np.interp(at, self.times, column) for column in self.values.T]
        return np.stack(columns, axis=1)


def timed_inputs(
    inputs: Any,
    input_times: Any,
    inputs_at: Any,
    system: StateSpaceModel,
    clock: Clock,
    record: int = 0,
) -> TimedInputs:
    """Check inputs of a system with times of their own."""
    names = system.inputs
    check_inputs_at(inputs_at)
    times = clock.numbers("input_times", input_times, record)
    check_increasing("input_times", times, lambda time: clock.shown(time, record))
    values = table_of("inputs", inputs, names, "inputs")
    if not names or values.shape != (times.size, len(names)):
        raise ModelError(
            f"inputs must have shape {(times.size, len(names))}, a row for each of input_times and "
            f"a column for each input of the system, got {np.shape(inputs)}"
        )
    return TimedInputs(times, values, inputs_at, system.observation_has_u)


def times_of_inputs(inputs: Sequence[Any], input_times: list[Any] | None) -> list[Any] | None:
    """The times of the inputs of each record: those given, else the dates in their own index.

    None for inputs by step.
    """
    if input_times is not None:
        return input_times
    found = [times_of_data(own) for own in inputs]
    missing = [own is None for own in found]
    if all(missing):
        return None
    if any(missing):
        raise ModelError(
            "inputs must have dates as their index in all records or in none, got none in record "
            f"number {missing.index(True)}"
        )
    return found


def check_inputs_at(inputs_at: Any) -> None:
    """Raise unless ``inputs_at`` is one of `INPUTS_AT`."""
    if not isinstance(inputs_at, str) or inputs_at not in INPUTS_AT:
        raise ModelError(f"inputs_at must be one of {list(INPUTS_AT)}, got {inputs_at!r}")
