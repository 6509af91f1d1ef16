"""The steps of a record: integers, or times on the grid of steps."""

from typing import Any

import numpy as np

from ..errors import ModelError
from .checks import check_finite, check_floats, check_positive, is_integer, shortened

# Times must lie on the grid of steps to this fraction of a step.
GRID_TOLERANCE = 1e-6

# Each step is computed. Beyond this a record would take hours, or not fit into memory.
MOST_STEPS = 10**9

ROWS_AT = ("observations", "steps")


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
            f"times[{at}] = {array[at]:.15g} is off the grid t0 + k*dt with t0 = {t0:g} and "
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


def check_steps(steps: Any) -> np.ndarray:
    """Integer steps, not negative, strictly increasing."""
    array = np.asarray(steps)
    if array.size == 0:
        raise ModelError(f"steps must hold at least one step, got {shortened(steps)}")
    if array.ndim == 1 and _holds_large_integers(array):
        raise _too_many_steps(float(max(array.tolist())))
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


def _numbers_of_time(times: Any) -> np.ndarray:
    """Times as floats; dates are refused, because their unit is not that of ``dt``."""
    array = np.asarray(times)
    is_text = array.dtype.kind in "SUO" and any(isinstance(t, str | bytes) for t in array.flat)
    if is_text or array.dtype.kind in "mM":
        what = "text: read dates with pd.to_datetime, then" if is_text else "dates or durations:"
        raise ModelError(
            f"times must be numbers in the unit of dt, got {what} write "
            "(times - times[0]) / np.timedelta64(1, 's') if dt is in seconds, and round them with "
            f"psf.nearest_steps; got {shortened(times)}"
        )
    return check_floats("times", times, 1)


def _checked_whole(steps: np.ndarray) -> np.ndarray:
    """Numbers of steps, still floats, refused if there are too many."""
    if (np.abs(steps) > MOST_STEPS).any():
        raise _too_many_steps(float(np.abs(steps).max()))
    return steps


def _holds_large_integers(array: np.ndarray) -> bool:
    """Whether all are integers, NumPy's or Python's, and one of them is too large."""
    if array.dtype == object and not all(is_integer(value) for value in array):
        return False
    return array.dtype.kind in "iuO" and bool((array > MOST_STEPS).any())


def _too_many_steps(number: float) -> ModelError:
    return ModelError(
        f"steps must be at most {MOST_STEPS:.0e}, each of which is computed, got {number:g}: take "
        "a larger dt, or a t0 close to the first time"
    )
