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
from .accumulators import n_input_rows, with_resets, with_symbolic_resets
from .checks import check_finite, check_floats, shortened
from .labels import columns_in_order
from .model import StateSpaceModel
from .steps import steps_of


class CheckedRecord(NamedTuple):
    """A record of numbers: steps (J,), data (J, p), inputs (rows, n_input_columns) and t0 ()."""

    steps: np.ndarray
    observed: np.ndarray
    inputs: np.ndarray
    t0: np.ndarray


def checked_record(
    system: StateSpaceModel, observed: Any, *, steps: Any, times: Any, inputs: Any, t0: Any
) -> CheckedRecord:
    """Check every part of a record of numbers."""
    t0 = check_finite("t0", t0)
    at = steps_of(steps, times, system.dt, t0)
    data = check_observed(observed, system, at.size)
    return CheckedRecord(at, data, check_inputs(inputs, system, at), np.asarray(t0))


class SymbolicRecord(NamedTuple):
    """A record of numbers or symbols, with the current numbers of its steps."""

    steps: Any
    current_steps: np.ndarray
    observed: Any
    inputs: Any
    t0: float


def symbolic_record(
    system: StateSpaceModel, observed: Any, *, steps: Any, times: Any, inputs: Any, t0: Any
) -> SymbolicRecord:
    """Check every part of a record as far as it is known: numbers and the values of shared data."""
    t0 = check_finite("t0", t0)
    if isinstance(times, Variable):
        raise ModelError("times must be numbers, got a symbol; give steps=pm.Data(...) instead")
    is_symbolic = isinstance(steps, Variable)
    current = steps_of(steps.eval() if is_symbolic else steps, times, system.dt, t0)
    return SymbolicRecord(
        steps if is_symbolic else current,
        current,
        None if observed is None else _symbolic_observed(observed, system, current),
        _symbolic_inputs(inputs, system, steps if is_symbolic else current, current),
        t0,
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


def _symbolic_inputs(
    inputs: Any, system: StateSpaceModel, steps: Any, current_steps: np.ndarray
) -> Any:
    if isinstance(inputs, Variable):
        inputs = _symbolic_inputs_of_user(inputs, system, current_steps)
    elif isinstance(steps, Variable):
        inputs = _check_inputs_of_user(inputs, system, current_steps)
    else:
        return check_inputs(inputs, system, steps)
    return with_symbolic_resets(system, inputs, steps) if system.accumulators else inputs


def _symbolic_inputs_of_user(
    inputs: Any, system: StateSpaceModel, steps: np.ndarray
) -> TensorVariable:
    if isinstance(inputs, SharedVariable):
        _check_inputs_of_user(inputs.get_value(), system, steps)
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


def check_inputs(inputs: Any, system: StateSpaceModel, steps: np.ndarray) -> np.ndarray:
    """The inputs as (rows, n_input_columns); row k holds during step k."""
    return with_resets(system, _check_inputs_of_user(inputs, system, steps), steps)


def _check_inputs_of_user(inputs: Any, system: StateSpaceModel, steps: np.ndarray) -> np.ndarray:
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
    needed = n_input_rows(system, steps)
    if array.shape[0] < needed:
        last_row = ", and the observation uses u" if system.observation_uses_inputs else ""
        raise ModelError(
            f"inputs must have at least {needed} rows, because the last observation is at step "
            f"{steps[-1]} (row k holds during step k{last_row}), got {array.shape[0]}"
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
