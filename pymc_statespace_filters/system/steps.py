"""The steps of a record: integers, and times rounded to the grid of steps."""

from typing import Any

import numpy as np

from ..errors import ModelError
from .checks import check_positive, is_integer, shortened
from .clock import clock_and_start

# Times must lie on the grid of steps to this fraction of a step.
GRID_TOLERANCE = 1e-6

# Each step is computed. Beyond this a record would take hours, or not fit into memory.
MOST_STEPS = 10**9

ROWS_AT = ("observations", "steps")


def nearest_steps(times: Any, dt: float, *, t0: Any = 0.0, unit: Any = None) -> np.ndarray:
    """Round real timestamps to the nearest steps of the grid ``t0 + k * dt``.

    A system with an integrator takes times as they are; one whose transition is a function takes
    whole steps.

    Parameters
    ----------
    times : array_like, shape (J,)
        Timestamps, increasing, numbers or dates.
    dt : float
        Length of a step.
    t0 : float or date
        Time of step 0; of dates, if it is a number, the first one is at ``t0``.
    unit : str or pandas.Timedelta, optional
        The duration of one unit of ``dt``, for dates; see `StateSpace`.

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
    dt = check_positive("dt", dt)
    clock, t0 = clock_and_start([times], t0, unit)
    array = clock.numbers("times", times)
    steps = _checked_whole(np.round((array - t0) / dt))
    if (clashes := np.flatnonzero(np.diff(steps) == 0)).size:
        pair = clock.shown(array[clashes[0] :][:2])
        first, second = (f"{time:g}" if clock.unit is None else time for time in pair)
        raise ModelError(
            f"times must fall on different steps of dt = {dt:g}, got {first} and {second}: "
            "take a smaller dt, merge the two, or give an integrator its times as they are"
        )
    return check_steps(steps.astype("int64"))


def check_steps(steps: Any) -> np.ndarray:
    """Integer steps, not negative, strictly increasing."""
    try:
        array = np.asarray(steps)
    except ValueError:
        raise ModelError(
            f"steps must be a vector of integers, got lists of several lengths, {shortened(steps)}:"
            " records side by side need panel="
        ) from None
    if array.size == 0:
        raise ModelError(f"steps must hold at least one step, got {shortened(steps)}")
    if array.ndim == 1 and _holds_large_integers(array):
        raise too_many_steps(float(max(array.tolist())))
    if array.dtype.kind not in "iu" or array.ndim != 1:
        raise ModelError(
            "steps must be a vector of integers (convert whole floats with .astype(int), give real "
            f"timestamps as times), got {shortened(steps)}"
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


def check_at(at: Any) -> None:
    """Raise unless ``at`` is one of `ROWS_AT`."""
    if not isinstance(at, str) or at not in list(ROWS_AT):
        raise ModelError(f"at must be one of {list(ROWS_AT)}, got {at!r}")


def rows_at(at: str, steps: np.ndarray) -> np.ndarray:
    """The requested steps: the observed ones, or all from 0 to the last observed one."""
    return steps if at == "observations" else np.arange(steps[-1] + 1)


def _checked_whole(steps: np.ndarray) -> np.ndarray:
    """Numbers of steps, still floats, refused if there are too many."""
    if (np.abs(steps) > MOST_STEPS).any():
        raise too_many_steps(float(np.abs(steps).max()))
    return steps


def _holds_large_integers(array: np.ndarray) -> bool:
    """Whether all are integers, NumPy's or Python's, and one of them is too large."""
    if array.dtype == object and not all(is_integer(value) for value in array):
        return False
    return array.dtype.kind in "iuO" and bool((array > MOST_STEPS).any())


def too_many_steps(number: float) -> ModelError:
    """The error for a record with so many steps."""
    return ModelError(
        f"steps must be at most {MOST_STEPS:.0e}, each of which is computed, got {number:g}: take "
        "a larger dt, or a t0 close to the first time"
    )
