"""A warning of numbers in data that probably stand for a missing value, such as -999."""

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Constant, Variable

from ..errors import ModelWarning
from .held_seed import INSIDE

# An end of the data is this many times the range of all others away from them, and, where no number
# is negative, farther than their range of logarithms: growth and decay have large ratios.
_FAR, _FAR_IN_LOGS = 20.0, 1.5
# Different numbers among the others; fewer say little of their range.
_LEAST_DIFFERENT = 5


def warn_of_missing_codes(name: str, observed: Variable, observables: Sequence[str]) -> None:
    """Warn of a number in the data (J, p) that lies far from all others."""
    if isinstance(observed, SharedVariable):
        values = observed.get_value()
    elif isinstance(observed, Constant):
        values = observed.data
    else:
        return
    for observable, column in zip(observables, values.T, strict=True):
        if (far := _far_number(column)) is not None:
            warnings.warn(
                f"observed of {name!r} has {observable} = {far:g} in "
                f"{_rows(np.flatnonzero(column == far))}, more than {_FAR:g} times the range of "
                "all other numbers away from them. If it stands for a missing value, put NaN there",
                ModelWarning,
                skip_file_prefixes=INSIDE,
            )


def _far_number(column: NDArray[np.float64]) -> float | None:
    """The smallest or largest number, if it is far from the others."""
    distinct = np.unique(column[np.isfinite(column)])
    if len(distinct) <= _LEAST_DIFFERENT:
        return None
    logs = distinct if distinct[0] < 0 else np.log(distinct + (distinct[0] == 0))
    for order in (slice(None), slice(None, None, -1)):
        if _is_far(distinct[order], _FAR) and _is_far(logs[order], _FAR_IN_LOGS):
            return float(distinct[order][0])
    return None


def _is_far(numbers: NDArray[np.float64], factor: float) -> bool:
    """Whether the first of ordered numbers is so many times the range of the others away."""
    with np.errstate(over="ignore"):
        gap, others = abs(numbers[0] - numbers[1]), abs(numbers[1] - numbers[-1])
        return bool(gap > factor * others)


def _rows(rows: NDArray[np.intp]) -> str:
    return f"row {rows[0]}" if len(rows) == 1 else f"{len(rows)} rows, first row {rows[0]}"
