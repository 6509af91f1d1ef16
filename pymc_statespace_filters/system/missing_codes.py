"""A warning of numbers in data that probably stand for a missing value, such as -999."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import ModelWarning, warn

if TYPE_CHECKING:
    from .model import StateSpaceModel

# An end of the data is this many times the range of all others away from them, and, where no number
# is negative, farther than their range of logarithms: growth and decay have large ratios.
_FAR, _FAR_IN_LOGS = 20.0, 1.5
# The same of numbers that often stand for a missing value.
_FAR_OF_CODES = 1.5
_CODES = (99.0, 999.0, 9999.0, 99999.0)
# Different numbers among the others; fewer say little of their range.
_LEAST_DIFFERENT = 5


def warn_of_missing_codes(system: "StateSpaceModel", observed: NDArray[np.float64]) -> None:
    """Warn of a number in the data (J, p) that lies far from all others."""
    for name, column in zip(system.observables, observed.T, strict=True):
        if (far := _far_number(column)) is not None:
            warn(
                f"observed has {name} = {far:g} in {_rows(np.flatnonzero(column == far))}, more "
                f"than {_factor(far):g} times the range of all other numbers away from them. If it "
                "stands for a missing value, put NaN there",
                ModelWarning,
            )


def has_missing_codes(observed: NDArray[np.float64]) -> bool:
    """Whether data (J, p) have such a number."""
    return any(_far_number(column) is not None for column in observed.T)


def _far_number(column: NDArray[np.float64]) -> float | None:
    """The smallest or largest number, if it is far from the others."""
    distinct = np.unique(column[np.isfinite(column)])
    if len(distinct) <= _LEAST_DIFFERENT:
        return None
    logs = distinct if distinct[0] < 0 else np.log(distinct + (distinct[0] == 0))
    for order in (slice(None), slice(None, None, -1)):
        factor = _factor(distinct[order][0])
        if _is_far(distinct[order], factor) and _is_far(logs[order], _FAR_IN_LOGS):
            return float(distinct[order][0])
    return None


def _factor(number: float) -> float:
    """How many times the range of the others a number is away from them to be named."""
    return _FAR_OF_CODES if abs(number) in _CODES else _FAR


def _is_far(numbers: NDArray[np.float64], factor: float) -> bool:
    """Whether the first of ordered numbers is so many times the range of the others away."""
    with np.errstate(over="ignore"):
        gap, others = abs(numbers[0] - numbers[1]), abs(numbers[1] - numbers[-1])
        return bool(gap > factor * others)


def _rows(rows: NDArray[np.intp]) -> str:
    return f"row {rows[0]}" if len(rows) == 1 else f"{len(rows)} rows, first row {rows[0]}"
