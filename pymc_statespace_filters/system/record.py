"""The record that a system is compared with: observation steps, data, inputs and t0.

`checked_record` takes numbers, `symbolic_record` takes numbers or symbols.
"""

from typing import Any, NamedTuple

import numpy as np
import pytensor.tensor as pt
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .checks import check_floats, shortened
from .clock import Clock
from .given_record import GivenRecord
from .input_columns import (
    n_input_rows,
    only_seen,
    warn_of_gaps_in_sums,
    with_columns,
    with_symbolic_columns,
)
from .labels import columns_in_order
from .model import StateSpaceModel
from .placement import Earlier
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
    system: StateSpaceModel, given: GivenRecord, earlier: Earlier | None = None
) -> CheckedRecord:
    """Check every part of a record of numbers; ``observed`` is None for a simulation."""
    placed = given.placed(system, earlier=earlier)
    (axis,), (rows,) = placed.axes, placed.inputs
    data = checked_data(given.observed, system, axis.steps.size)
    rows = check_inputs(rows, placed.system, axis)
    if given.observed is not None:
        rows = only_seen(system, rows, axis.steps, data)
    return CheckedRecord(placed.system, placed.clock, axis, data, rows)


class SymbolicRecord(NamedTuple):
    """A record of numbers or symbols, with the current numbers of its steps on its axis."""

    system: StateSpaceModel
    clock: Clock
    axis: TimeAxis
    steps: Any
    observed: Any
    inputs: Any
    timed: tuple[TimedInputs, ...]


def symbolic_record(system: StateSpaceModel, given: GivenRecord) -> SymbolicRecord:
    """Check every part of a record as far as it is known: numbers and the values of shared data."""
    placed = given.current().placed(system)
    (axis,), (rows,) = placed.axes, placed.inputs
    steps = given.steps if isinstance(given.steps, Variable) else axis.steps
    data = symbolic_data(given.observed, system, axis.steps.size)
    inputs = _symbolic_inputs(rows, placed.system, steps, axis)
    return SymbolicRecord(
        placed.system,
        placed.clock,
        axis,
        steps,
        data,
        only_seen(system, inputs, steps, data),
        placed.timed,
    )


def symbolic_data(observed: Any, system: StateSpaceModel, n_rows: int) -> Variable | None:
    """The data (J, p) as a symbol, if there are any; of a symbol, what is known is checked."""
    if observed is None:
        return None
    if not isinstance(observed, Variable):
        # A symbol, because PyMC would mask and impute the NaN of an array.
        return pt.as_tensor(checked_data(observed, system, n_rows))
    if observed.type.ndim != 2:
        raise ModelError(
            "observed must have 2 dimensions (rows, observables) if it is symbolic, as pm.Data is, "
            f"got {observed.type.ndim}: for one observable give it values[:, None]"
        )
    if isinstance(observed, SharedVariable):
        checked_data(observed.get_value(), system, n_rows)
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


def checked_data(observed: Any, system: StateSpaceModel, n_rows: int) -> np.ndarray:
    """The data (J, p), all missing in a simulation."""
    if observed is None:
        return np.full((n_rows, system.p), np.nan)
    data = check_observed(observed, system, n_rows)
    warn_of_gaps_in_sums(system, data)
    return data


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
