"""The record that a system is compared with: observation steps, data, inputs; checked once."""

from numbers import Integral
from typing import Any, NamedTuple

import numpy as np

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system.equations import positive
from pymc_statespace_filters.system.model import StateSpaceModel

# Times must lie on the grid of steps to this fraction of a step.
GRID_TOLERANCE = 1e-6

ROWS_AT = ("observations", "steps")


class CheckedRecord(NamedTuple):
    """A record as machine code reads it: steps (J,), data (J, p), inputs (rows, n), t0 ()."""

    steps: np.ndarray
    observed: np.ndarray
    inputs: np.ndarray
    t0: np.ndarray


def checked_record(
    system: StateSpaceModel, observed: Any, *, steps: Any, times: Any, inputs: Any, t0: Any
) -> CheckedRecord:
    """The record that a user gives for a system, every part of it checked."""
    t0 = check_t0(t0)
    at = steps_of(steps, times, system.dt, t0)
    data = check_observed(observed, system, at.size)
    return CheckedRecord(at, data, check_inputs(inputs, system, at), np.asarray(t0))


def check_system(system: Any) -> None:
    """Raise unless this is a system."""
    if not isinstance(system, StateSpaceModel):
        raise ModelError(f"system must be a StateSpaceModel, got {system!r}")


def check_steps(steps: Any) -> np.ndarray:
    """Integer steps, not negative, strictly increasing."""
    array = np.asarray(steps)
    if array.size == 0:
        raise ModelError("steps is empty: a record has at least one observation")
    if array.dtype.kind not in "iu" or array.ndim != 1:
        raise ModelError(
            f"steps must be a vector of integers (step numbers; real timestamps are `times`), "
            f"got {_short(steps)}"
        )
    if array[0] < 0:
        raise ModelError(f"steps must not be negative, got {array[0]}")
    if (np.diff(array.astype("int64")) <= 0).any():
        at = int(np.argmax(np.diff(array.astype("int64")) <= 0))
        raise ModelError(
            f"steps must increase strictly, but steps[{at}] = {array[at]} "
            f"is followed by {array[at + 1]}"
        )
    return array.astype("int64")


def steps_of(steps: Any, times: Any, dt: float, t0: float) -> np.ndarray:
    """The step numbers of a record, given as steps or as times on the grid ``t0 + k * dt``."""
    if (steps is None) == (times is None):
        raise ModelError("give exactly one of steps and times")
    if steps is not None:
        return check_steps(steps)
    array = _floats("times", times, 1)
    exact = (array - t0) / dt
    whole = np.round(exact)
    off = np.abs(exact - whole)
    if (off > GRID_TOLERANCE).any():
        at = int(np.argmax(off))
        raise ModelError(
            f"times[{at}] = {array[at]!r} is off the grid t0 + k*dt with t0 = {t0:g} and "
            f"dt = {dt:g} by {off[at]:.3g} steps; round with psf.nearest_steps(times, dt, t0=t0)"
        )
    return check_steps(whole.astype("int64"))


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
        If two timestamps fall on one step, or one before ``t0``.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.nearest_steps([0.0, 0.101, 0.199], dt=0.01)
    array([ 0, 10, 20])
    """
    if np.asarray(times).dtype.kind in "mM":
        raise ModelError(
            "times must be numbers in the units of dt (seconds from a start), not dates"
        )
    array = _floats("times", times, 1)
    dt, t0 = positive("dt", dt), check_t0(t0)
    steps = np.round((array - t0) / dt)
    if (clashes := np.flatnonzero(np.diff(steps) == 0)).size:
        first, second = array[clashes[0]], array[clashes[0] + 1]
        raise ModelError(
            f"times {first:g} and {second:g} fall on one step of dt = {dt:g}: take a smaller dt, "
            "or one value for both"
        )
    return check_steps(steps.astype("int64"))


def check_at(at: Any) -> None:
    """Raise unless this names the steps at which states are wanted."""
    if at not in list(ROWS_AT):
        raise ModelError(f"at must be one of {list(ROWS_AT)}, got {at!r}")


def rows_at(at: str, steps: np.ndarray) -> np.ndarray:
    """The steps at which states are wanted: those observed, or all from 0 to the last of them."""
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


def n_input_rows(system: StateSpaceModel, steps: np.ndarray) -> int:
    """How many rows of inputs a record needs: one per step, one more if it is observed too."""
    return int(steps[-1]) + int(system.observation_uses_inputs) if steps.size else 0


def check_inputs(inputs: Any, system: StateSpaceModel, steps: np.ndarray) -> np.ndarray:
    """The inputs as (rows, n_inputs); row k holds during step k."""
    if inputs is None:
        if system.n_inputs:
            raise ModelError(
                f"the system has the inputs {list(system.inputs)}; give inputs=, one row per step"
            )
        return np.zeros((0, 0))
    if not system.n_inputs:
        raise ModelError(
            "inputs are given, but the system names none (StateSpaceModel(inputs=[...]))"
        )
    array = _floats("inputs", inputs, None)
    if array.ndim == 1 and system.n_inputs == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[1] != system.n_inputs:
        raise ModelError(
            f"inputs must have shape (steps, {system.n_inputs}), a column for each of "
            f"{list(system.inputs)}, got {np.shape(inputs)}"
        )
    needed = n_input_rows(system, steps)
    if array.shape[0] < needed:
        raise ModelError(
            f"inputs has {array.shape[0]} rows, but the last observation is at step {steps[-1]} "
            f"and needs {needed} (row k holds during step k"
            f"{', and the observation asks for u' if system.observation_uses_inputs else ''})"
        )
    return array


def check_seed(name: str, seed: Any) -> np.ndarray:
    """Integers within 64 bits."""
    array = np.asarray(seed)
    if array.dtype.kind not in "iu":
        raise ModelError(f"{name} must be an integer, got {_short(seed)}")
    if (array > np.iinfo("int64").max).any():
        raise ModelError(f"{name} must be below 2**63, got {_short(seed)}")
    return array.astype("int64")


def check_random_seed(random_seed: Any) -> np.random.Generator:
    """The generator of a seed that a user gave."""
    try:
        return np.random.default_rng(random_seed)
    except (TypeError, ValueError):
        raise ModelError(
            f"random_seed must be None, an integer that is not negative or a "
            f"numpy.random.Generator, got {random_seed!r}"
        ) from None


def is_whole(value: Any) -> bool:
    """Whether a value is an integer, Python's or NumPy's."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def check_t0(t0: Any) -> float:
    """A finite time of step 0."""
    number = isinstance(t0, int | float | np.number) and not isinstance(t0, bool)
    if not number or not np.isfinite(t0):
        raise ModelError(f"t0 must be a finite number, got {t0!r}")
    return float(t0)


def _floats(name: str, value: Any, ndim: int | None, *, missing: bool = False) -> np.ndarray:
    if np.ma.isMaskedArray(value):
        value = np.ma.filled(np.ma.asarray(value, dtype="float64"), np.nan)
    try:
        array = np.array(value, dtype="float64")
    except (TypeError, ValueError):
        raise ModelError(f"{name} must be numbers, got {_short(value)}") from None
    if ndim is not None and array.ndim != ndim:
        raise ModelError(f"{name} must have {ndim} dimension(s), got shape {array.shape}")
    bad = np.isinf(array) if missing else ~np.isfinite(array)
    if bad.any():
        at = tuple(int(i) for i in np.argwhere(bad)[0])
        allowed = "numbers, or NaN where missing" if missing else "finite numbers"
        place = f"{name}[{', '.join(map(str, at))}]" if at else name
        raise ModelError(f"{name} must hold {allowed}, but {place} is {array[at]}")
    return array


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
