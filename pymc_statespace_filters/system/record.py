"""The record that a system is compared with: observation steps, data, inputs and t0.

`checked_record` takes numbers, `symbolic_record` takes numbers or symbols.
"""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytensor.tensor as pt
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .checks import check_floats, shortened
from .clock import Clock, times_of_data
from .input_columns import n_input_rows, with_columns, with_symbolic_columns
from .labels import columns_in_order
from .model import StateSpaceModel
from .placement import Earlier, Timing, place
from .time_axis import TimeAxis
from .timed_inputs import TimedInputs


class CheckedRecord(NamedTuple):
    """A record of numbers: data (J, p) and inputs (rows, n_input_columns), on an axis of time.

    ``system`` is the one that takes the steps of this axis.
    """

    system: StateSpaceModel
    clock: Clock
    axis: TimeAxis
    observed: np.ndarray
    inputs: np.ndarray

    @property
    def arguments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Steps, data, inputs and t0, as a likelihood takes them."""
        return self.axis.steps, self.observed, self.inputs, np.asarray(self.axis.t0)

    def times(self, steps: Any) -> np.ndarray:
        """The user's times of steps."""
        return self.clock.shown(self.axis.times(steps))


def checked_record(
    system: StateSpaceModel,
    observed: Any,
    *,
    steps: Any = None,
    times: Any = None,
    inputs: Any = None,
    t0: Any = 0.0,
    unit: Any = None,
    input_times: Any = None,
    inputs_at: Any = "hold",
    earlier: Earlier | None = None,
) -> CheckedRecord:
    """Check every part of a record of numbers; ``observed`` is None for a simulation."""
    times = _times(observed, steps, times)
    timing = _timing(steps, times, t0, unit, inputs, input_times, inputs_at)
    placed = place(system, timing._replace(earlier=earlier))
    (axis,), (rows,) = placed.axes, placed.inputs
    if observed is None:
        data = np.full((axis.steps.size, system.p), np.nan)
    else:
        data = check_observed(observed, system, axis.steps.size)
    rows = check_inputs(rows, placed.system, axis)
    return CheckedRecord(placed.system, placed.clock, axis, data, rows)


def _times(observed: Any, steps: Any, times: Any) -> Any:
    """The times of a record: those given, else the dates that the data bring."""
    if steps is not None or times is not None:
        return times
    found = times_of_data(observed)
    if found is None and isinstance(observed, pd.Series | pd.DataFrame):
        raise ModelError(
            "give exactly one of steps and times, or dates as the index of observed (read text with"
            f" pd.to_datetime): it holds no dates, got {shortened(observed.index)}"
        )
    return found


def _timing(
    steps: Any, times: Any, t0: Any, unit: Any, inputs: Any, input_times: Any, inputs_at: Any
) -> Timing:
    """The timing of a single record."""
    if isinstance(times, Variable):
        raise ModelError("times must be numbers, got a symbol; give steps=pm.Data(...) instead")
    if input_times is not None and isinstance(inputs, Variable):
        raise ModelError("inputs must be numbers where input_times are given, got a symbol")
    at, own = ([value] if value is not None else None for value in (times, input_times))
    return Timing(None if steps is None else [steps], at, t0, unit, [inputs], own, inputs_at)


class SymbolicRecord(NamedTuple):
    """A record of numbers or symbols, with the current numbers of its steps on its axis."""

    system: StateSpaceModel
    clock: Clock
    axis: TimeAxis
    steps: Any
    observed: Any
    inputs: Any
    timed: tuple[TimedInputs, ...]


def symbolic_record(
    system: StateSpaceModel,
    observed: Any,
    *,
    steps: Any,
    times: Any,
    inputs: Any,
    t0: Any,
    unit: Any,
    input_times: Any,
    inputs_at: Any,
) -> SymbolicRecord:
    """Check every part of a record as far as it is known: numbers and the values of shared data."""
    times = _times(observed, steps, times)
    is_symbolic = isinstance(steps, Variable)
    current = steps.eval() if is_symbolic else steps
    placed = place(system, _timing(current, times, t0, unit, inputs, input_times, inputs_at))
    (axis,), (rows,) = placed.axes, placed.inputs
    steps = steps if is_symbolic else axis.steps
    return SymbolicRecord(
        placed.system,
        placed.clock,
        axis,
        steps,
        None if observed is None else _symbolic_observed(observed, system, axis.steps),
        _symbolic_inputs(rows, placed.system, steps, axis),
        placed.timed,
    )


def _symbolic_observed(observed: Any, system: StateSpaceModel, steps: np.ndarray) -> Variable:
    if not isinstance(observed, Variable):
        # A symbol, because PyMC would mask and impute the NaN of an array.
        return pt.as_tensor(check_observed(observed, system, steps.size))
    if observed.type.ndim != 2:
        raise ModelError(
            f"observed must have 2 dimensions (observations, observables) if it is symbolic, "
            f"got {observed.type.ndim}"
        )
    if isinstance(observed, SharedVariable):
        check_observed(observed.get_value(), system, steps.size)
    return observed


def _symbolic_inputs(inputs: Any, system: StateSpaceModel, steps: Any, axis: TimeAxis) -> Any:
    if isinstance(inputs, Variable):
        inputs = _symbolic_inputs_of_user(inputs, system, axis)
    elif isinstance(steps, Variable):
        inputs = _check_inputs_of_user(inputs, system, axis)
    else:
        return check_inputs(inputs, system, axis)
    return with_symbolic_columns(system, inputs, steps, axis)


def _symbolic_inputs_of_user(
    inputs: Any, system: StateSpaceModel, axis: TimeAxis
) -> TensorVariable:
    if isinstance(inputs, SharedVariable):
        _check_inputs_of_user(inputs.get_value(), system, axis)
    if inputs.type.ndim == 1 and system.n_inputs == 1:
        inputs = inputs[:, None]
    if not system.n_inputs or inputs.type.ndim != 2:
        raise inputs_of_other_shape(system, inputs.type)
    return inputs


def inputs_of_other_shape(system: StateSpaceModel, found: Any) -> ModelError:
    """The error for inputs with other columns than those of the system."""
    return ModelError(
        f"inputs must have shape (steps, {system.n_inputs}), a column for each of "
        f"{list(system.inputs)}, got {found}"
    )


def check_system(system: Any) -> None:
    """Raise unless ``system`` is a `StateSpaceModel`."""
    if not isinstance(system, StateSpaceModel):
        raise ModelError(f"system must be a StateSpaceModel, got {system!r}")


def check_observed(observed: Any, system: StateSpaceModel, n_observations: int) -> np.ndarray:
    """The data as (J, p); NaN marks what is missing."""
    observed = columns_in_order("observed", observed, system.observables, "observables")
    array = check_floats("observed", observed, None, missing=True)
    if array.ndim == 1 and system.p == 1:
        array = array[:, None]
    if array.shape != (n_observations, system.p):
        raise ModelError(
            f"observed must have shape {(n_observations, system.p)} (observations x observables), "
            f"got {np.shape(observed)}"
        )
    return array


def check_inputs(inputs: Any, system: StateSpaceModel, axis: TimeAxis) -> np.ndarray:
    """The inputs as (rows, n_input_columns); row k holds during step k."""
    return with_columns(system, _check_inputs_of_user(inputs, system, axis), axis)


def _check_inputs_of_user(inputs: Any, system: StateSpaceModel, axis: TimeAxis) -> np.ndarray:
    if inputs is None:
        if system.n_inputs:
            raise ModelError(
                f"inputs must have a row per step and a column for each of {list(system.inputs)}, "
                f"got None"
            )
        return np.zeros((0, 0))
    if not system.n_inputs:
        raise ModelError(
            f"inputs must be None for a system without inputs, got {shortened(inputs)}; name them "
            f"in the system (StateSpaceModel(inputs=[...]))"
        )
    inputs = columns_in_order("inputs", inputs, system.inputs, "inputs")
    array = check_floats("inputs", inputs, None)
    if array.ndim == 1 and system.n_inputs == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[1] != system.n_inputs:
        raise inputs_of_other_shape(system, np.shape(inputs))
    needed = n_input_rows(system, axis.steps)
    if axis.starts is not None and len(array) not in (needed, axis.starts.size):
        raise ModelError(
            f"inputs must have times of their own (input_times=) where times are off the grid of "
            f"steps, or a row for each of the {axis.starts.size - 1} steps between them, got "
            f"{len(array)} rows"
        )
    if array.shape[0] < needed:
        last_row = ", and the observation uses u" if system.observation_uses_inputs else ""
        raise ModelError(
            f"inputs must have at least {needed} rows, because the last observation is at step "
            f"{axis.steps[-1]} (row k holds during step k{last_row}), got {array.shape[0]}"
        )
    return array


def check_seed(name: str, seed: Any) -> np.ndarray:
    """Return seeds as an array of 64-bit integers."""
    array = np.asarray(seed)
    if array.dtype.kind not in "iu":
        raise ModelError(f"{name} must be an integer, got {shortened(seed)}")
    if (array > np.iinfo("int64").max).any():
        raise ModelError(f"{name} must be below 2**63, got {shortened(seed)}")
    return array.astype("int64")
