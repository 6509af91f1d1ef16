"""Where the observations and inputs of records lie: from what a user gives to steps and rows."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..errors import ModelError
from .clock import Clock, are_dates, check_zones, clock_and_start, unit_text
from .events import Events, read_events, with_events
from .model import StateSpaceModel
from .panel_records import ALONE
from .signature import BEFORE
from .steps import GRID_TOLERANCE, check_steps
from .time_axis import (
    NO_EVENTS,
    TimeAxis,
    TimesBetween,
    axis_of,
    check_increasing,
    divided_axis,
    is_grid,
    off_grid,
    preceding,
)
from .timed_inputs import TimedInputs, check_inputs_at, timed_inputs, times_of_inputs


class Earlier(NamedTuple):
    """Where some records go on from: their clock and t0, and the last step of each so far.

    ``ends`` are the times of these steps, of records at any times; None on a grid.
    """

    clock: Clock
    t0: float
    steps: list[int]
    ends: list[float] | None

    def axis(self, given: TimesBetween, dt: float, record: int) -> TimeAxis:
        """The axis of a record at any times; its earlier steps, which are over, have no length."""
        assert self.ends is not None
        end, k = self.ends[record], self.steps[record]
        if given.times[0] <= end:
            raise ModelError(
                f"times must come after the last row of the earlier run, which is at "
                f"{self.clock.shown([end], record)[0]}, got "
                f"{self.clock.shown(given.times[:1], record)[0]}"
            )
        own = divided_axis(given.times, t0=end, dt=dt, breaks=given.breaks, events=given.events)
        assert own.starts is not None
        assert own.lengths is not None
        starts = np.concatenate([np.full(k, end), own.starts])
        lengths = np.concatenate([np.zeros(k), own.lengths])
        return TimeAxis(own.steps + k, self.t0, dt, starts, lengths)


class Timing(NamedTuple):
    """What a user says of the times of some records; of a list, an entry for each record.

    ``events`` are tables, or what `read_events` has made of them. ``steps`` or ``times`` is None;
    ``input_times`` is None for inputs by step, and for those whose index holds their dates.
    """

    steps: list[Any] | None
    times: list[Any] | None
    t0: Any
    unit: Any
    inputs: list[Any]
    input_times: list[Any] | None
    inputs_at: Any
    events: list[Any]
    earlier: Earlier | None = None


class Placement(NamedTuple):
    """The axis of each record, and its inputs by step, as the user gave them or from their times.

    ``system`` is the one at any times where an axis is not a grid; ``timed`` are
    the inputs of each record that have times of their own, if they do, and ``events`` its events,
    if the system has some.
    """

    system: StateSpaceModel
    clock: Clock
    axes: list[TimeAxis]
    inputs: list[Any]
    timed: tuple[TimedInputs, ...] = ()
    events: tuple[Events, ...] = ()


def place(
    system: StateSpaceModel, timing: Timing, check_each: Callable[..., list[Any]]
) -> Placement:
    """Find the steps of some records; ``check_each`` calls a check for each, see `Records`."""
    check_inputs_at(timing.inputs_at)
    if (timing.steps is None) == (timing.times is None):
        raise ModelError("give exactly one of steps and times")
    check_zones(_dates(timing))
    if timing.earlier is None or timing.earlier.clock.unit is None:
        clock, t0 = clock_and_start(timing.times, timing.t0, timing.unit)
    else:
        clock, t0 = timing.earlier.clock, timing.earlier.t0
    return place_by(clock, t0, system, timing, range(len(timing.inputs)), check_each)


def _dates(timing: Timing) -> dict[str, Any]:
    """What of a timing holds dates, by the name of its argument; of records, those of the first."""
    firsts = {
        "times": timing.times and timing.times[0],
        "t0": timing.t0,
        "input_times": (times := times_of_inputs(timing.inputs, timing.input_times)) and times[0],
    }
    return {name: value for name, value in firsts.items() if are_dates(value)}


def place_by(
    clock: Clock,
    t0: float,
    system: StateSpaceModel,
    timing: Timing,
    numbers: Sequence[int],
    check_each: Callable[..., list[Any]] = ALONE.check_each,
) -> Placement:
    """The same by a clock that is known, for the records of these numbers."""
    timed, input_times = None, timing.input_times
    if timing.steps is None or clock.unit is not None:
        input_times = times_of_inputs(timing.inputs, input_times)
    if input_times is not None:
        timed = check_each(
            lambda g, inputs, times: timed_inputs(
                inputs, times, timing.inputs_at, system, clock, g
            ),
            numbers, timing.inputs, input_times,
        )  # fmt: skip
    events = check_each(
        lambda g, own: (
            own if isinstance(own, Events) else read_events(own, system, clock, t0, g)
        ),
        numbers, timing.events,
    )  # fmt: skip
    nothing = [None] * len(numbers)
    changes = [np.empty(0)] * len(numbers) if timed is None else [one.changes() for one in timed]

    def between(
        g: int, steps: Any, times: Any, changes: np.ndarray, own: Events | None
    ) -> TimesBetween:
        if steps is None:
            at = _times_from(t0, times, system.dt, clock, g)
        else:
            steps = check_steps(steps)
            at = t0 + steps * system.dt
        # Inputs may change before step 0 or after the last observation.
        inside = (changes > t0) & (changes < at[-1])
        when = NO_EVENTS if own is None else own.at
        return TimesBetween(steps, at, t0, changes[inside], when)

    given = check_each(
        between, numbers, timing.steps or nothing, timing.times or nothing, changes, events
    )
    if not is_grid(given, system.dt):
        check_each(lambda g, one: check_takes(system, one, clock, g), numbers, given)
        system = system.at_any_times
    if any(preceding(one, system.dt).any() for one in given):
        system = system.with_instant_steps()
    earlier, is_on_grid = timing.earlier, not system.is_at_any_times
    if earlier is not None and not is_on_grid:
        axes = check_each(lambda g, one: earlier.axis(one, system.dt, g), numbers, given)
    else:
        axes = check_each(lambda one: axis_of(one, system.dt, on_grid=is_on_grid), given)
    axes = check_each(lambda g, axis, own: with_events(axis, own, clock, g), numbers, axes, events)
    found = tuple(own for own in events if own is not None)
    if timed is None:
        return Placement(system, clock, axes, timing.inputs, (), found)
    rows = check_each(lambda g, one, axis: one.rows(axis, clock, g), numbers, timed, axes)
    return Placement(system, clock, axes, rows, tuple(timed), found)


def _times_from(t0: float, given: Any, dt: float, clock: Clock, record: int) -> np.ndarray:
    """Times as numbers, which increase from t0 on."""
    times = clock.numbers("times", given, record)
    if times.size == 0:
        raise ModelError("times must hold at least one time, got none")
    check_increasing("times", times, lambda time: clock.shown(time, record))
    if times[0] < t0 - GRID_TOLERANCE * dt:
        start, first = clock.shown([t0, times[0]], record)
        raise ModelError(
            f"times must not lie before t0 = {_text(start)}, where the initial state holds, got "
            f"times[0] = {_text(first)}"
        )
    return times


def _text(time: Any) -> str:
    """A time as a user reads it, a number or a date."""
    return str(time) if isinstance(time, np.datetime64) else f"{time:.15g}"


def check_takes(system: StateSpaceModel, given: TimesBetween, clock: Clock, record: int) -> None:
    """Raise if a step of the system has one length, and a time is off the grid."""
    if system.why_one_length is None:
        return
    if (first := np.flatnonzero(preceding(given, system.dt))).size:
        value = _text(clock.shown(given.events.times, record)[first[0]])
        raise ModelError(
            f"the event at {value} must not come before the observation at its time, as this takes "
            f"a step of length zero and {system.why_one_length}: let it come after the observation "
            f"({BEFORE!r} of events is 0), or be one step earlier"
        )
    places = {"times": given.times, "input_times": given.breaks, "events": given.events.times}
    for name, times in places.items():
        off = off_grid(times, given.t0, system.dt)
        if (off > GRID_TOLERANCE).any():
            rows = np.flatnonzero(off > GRID_TOLERANCE)
            at = int(rows[0])
            value = _text(clock.shown(times, record)[at])
            what = f"times[{at}] = {value} is"
            if name == "input_times":
                what = f"the change of the inputs at {value} is"
            elif name == "events":
                what = f"the event at {value} is"
            elif 1 < rows.size == times.size:
                what = f"all {rows.size} rows of times, the first at {value}, are"
            raise ModelError(
                f"{what} off the grid t0 + k*dt with {_grid(given.t0, system.dt, clock, record)}"
                f" by {off[at]:.3g} steps, and {system.why_one_length}; round with "
                f"{_rounding(clock)}"
            )


def _grid(t0: float, dt: float, clock: Clock, record: int) -> str:
    """The grid as a user gives it."""
    if clock.unit is None:
        return f"t0 = {t0:g} and dt = {dt:g}"
    return f"t0 = {clock.shown([t0], record)[0]}, dt = {dt:g} and unit={unit_text(clock.unit)}"


def _rounding(clock: Clock) -> str:
    """The call that rounds times to steps."""
    if clock.unit is None:
        return "steps=psf.nearest_steps(times, dt, t0=t0)"
    return f"steps=psf.nearest_steps(dates, dt, t0=t0, unit={unit_text(clock.unit)})"
