"""The record that a system is compared with: observation steps, data, inputs and t0.

`checked_record` takes numbers, `symbolic_record` takes numbers or symbols.
"""

from typing import Any, NamedTuple

import numpy as np
import pytensor.tensor as pt
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system.accumulators import (
    n_input_rows,
    with_resets,
    with_symbolic_resets,
)
from pymc_statespace_filters.system.checks import (
    check_finite,
    check_positive,
    is_integer,
    shortened,
)
from pymc_statespace_filters.system.model import StateSpaceModel

# Times must lie on the grid of steps to this fraction of a step.
GRID_TOLERANCE = 1e-6

# Beyond this a record would take hours, or not fit into memory; each step is computed.
MOST_STEPS = 10**9

ROWS_AT = ("observations", "steps")


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


def check_steps(steps: Any) -> np.ndarray:
    """Integer steps, not negative, strictly increasing."""
    array = np.asarray(steps)
    if array.size == 0:
        raise ModelError(f"steps must hold at least one step, got {shortened(steps)}")
    if array.ndim == 1 and _holds_large_integers(array):
        raise _too_many_steps(float(max(array.tolist())))
    if array.dtype.kind not in "iu" or array.ndim != 1:
        raise ModelError(
            f"steps must be a vector of integers (give real timestamps as times), got "
            f" {shortened(steps)}"
        )
    if array[0] < 0:
        raise ModelError(f"steps must not be negative, got {array[0]}")
    if (np.diff(array.astype("int64")) <= 0).any():
        at = int(np.argmax(np.diff(array.astype("int64")) <= 0))
        raise ModelError(
            f"steps must increase strictly, got steps[{at}] = {array[at]} "
            f"followed by {array[at + 1]}"
        )
    return array.astype("int64")


def _holds_large_integers(array: np.ndarray) -> bool:
    """Whether all are integers, NumPy's or Python's, and one of them is too large."""
    if array.dtype == object and not all(is_integer(value) for value in array):
        return False
    return array.dtype.kind in "iuO" and bool((array > MOST_STEPS).any())


def steps_of(steps: Any, times: Any, dt: float, t0: float) -> np.ndarray:
    """The step numbers of a record, given as steps or as times on the grid ``t0 + k * dt``."""
    if (steps is None) == (times is None):
        raise ModelError("give exactly one of steps and times")
    if steps is not None:
        return check_steps(steps)
    array = _numbers_of_time(times)
    exact = (array - t0) / dt
    whole = _checked_whole(np.round(exact))
    off = np.abs(exact - whole)
    if (off > GRID_TOLERANCE).any():
        at = int(np.argmax(off))
        raise ModelError(
            f"times[{at}] = {array[at]!r} is off the grid t0 + k*dt with t0 = {t0:g} and "
            f"dt = {dt:g} by {off[at]:.3g} steps; round with psf.nearest_steps(times, dt, t0=t0)"
        )
    return check_steps(whole.astype("int64"))


def _numbers_of_time(times: Any) -> np.ndarray:
    """Times as floats; dates are refused, because their unit is not that of ``dt``."""
    if np.asarray(times).dtype.kind in "mM":
        raise ModelError(
            "times must be numbers in the unit of dt, got dates or durations: write "
            "(times - times[0]) / np.timedelta64(1, 's') if dt is in seconds, and round them with "
            f"psf.nearest_steps; got {shortened(times)}"
        )
    return _floats("times", times, 1)


def _checked_whole(steps: np.ndarray) -> np.ndarray:
    """Numbers of steps, still floats, that fit into integers."""
    if (np.abs(steps) > MOST_STEPS).any():
        raise _too_many_steps(float(np.abs(steps).max()))
    return steps


def _too_many_steps(number: float) -> ModelError:
    return ModelError(
        f"steps must be at most {MOST_STEPS:.0e}, each of which is computed, got {number:g}: take "
        "a larger dt, or a t0 close to the first time"
    )


def nearest_steps(times: Any, dt: float, *, t0: float = 0.0) -> np.ndarray:
    """Round real timestamps to the nearest steps of the grid ``t0 + k * dt``.

    Parameters
    ----------
    times : array_like, shape (J,)
        Timestamps, increasing.
    dt : float
        Length of a step.
    t0 : float
        Time of step 0.

    Returns
    -------
    ndarray of int, shape (J,)

    Raises
    ------
    ModelError
        If two timestamps fall on one step, or one lies before ``t0``.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.nearest_steps([0.0, 0.101, 0.199], dt=0.01)
    array([ 0, 10, 20])
    """
    array = _numbers_of_time(times)
    dt, t0 = check_positive("dt", dt), check_finite("t0", t0)
    steps = _checked_whole(np.round((array - t0) / dt))
    if (clashes := np.flatnonzero(np.diff(steps) == 0)).size:
        first, second = array[clashes[0]], array[clashes[0] + 1]
        raise ModelError(
            f"times must fall on different steps of dt = {dt:g}, got {first:g} and {second:g}: "
            "take a smaller dt, or merge the two observations"
        )
    return check_steps(steps.astype("int64"))


def check_at(at: Any) -> None:
    """Raise unless ``at`` is one of `ROWS_AT`."""
    if at not in list(ROWS_AT):
        raise ModelError(f"at must be one of {list(ROWS_AT)}, got {at!r}")


def rows_at(at: str, steps: np.ndarray) -> np.ndarray:
    """The requested steps: the observed ones, or all from 0 to the last observed one."""
    return steps if at == "observations" else np.arange(steps[-1] + 1)


def check_observed(observed: Any, system: StateSpaceModel, n_observations: int) -> np.ndarray:
    """The data as (J, p); NaN marks what is missing."""
    array = _floats("observed", observed, None, missing=True)
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
    array = _floats("inputs", inputs, None)
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


def _floats(name: str, value: Any, ndim: int | None, *, missing: bool = False) -> np.ndarray:
    if np.ma.isMaskedArray(value):
        value = np.ma.filled(np.ma.asarray(value, dtype="float64"), np.nan)
    try:
        array = np.array(value, dtype="float64")
    except (TypeError, ValueError):
        raise ModelError(f"{name} must be numbers, got {shortened(value)}") from None
    if ndim is not None and array.ndim != ndim:
        raise ModelError(f"{name} must have {ndim} dimension(s), got shape {array.shape}")
    bad = np.isinf(array) if missing else ~np.isfinite(array)
    if bad.any():
        at = tuple(int(i) for i in np.argwhere(bad)[0])
        allowed = "numbers, or NaN where missing" if missing else "finite numbers"
        place = f"{name}[{', '.join(map(str, at))}]" if at else name
        raise ModelError(f"{name} must hold {allowed}, got {place} = {array[at]}")
    return array
