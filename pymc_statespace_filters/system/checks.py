"""Checks of numbers that users give: integers, positive numbers, seeds, arrays."""

import math
from numbers import Integral, Real
from typing import Any, TypeGuard

import numpy as np
import pandas as pd

from ..errors import ModelError


def is_integer(value: Any) -> TypeGuard[int]:
    """Whether a value is an integer, Python's or NumPy's, and not a truth value."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_finite(value: Any) -> bool:
    """Whether a value is a finite real number, Python's or NumPy's, and not a truth value."""
    if not isinstance(value, Real) or isinstance(value, bool | np.bool_):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond the largest float
        return False


def check_count(name: str, value: Any, least: int, most: int | None = None) -> int:
    """Return ``value`` as an int of at least ``least`` and at most ``most``."""
    if not is_integer(value) or value < least:
        raise ModelError(f"{name} must be an integer of at least {least}, got {value!r}")
    if most is not None and value > most:
        raise ModelError(f"{name} must be at most {most}, got {value!r}")
    return int(value)


def check_positive(name: str, value: Any) -> float:
    """Return ``value`` as a positive float, such as a length of time."""
    if not is_finite(value) or value <= 0:
        raise ModelError(f"{name} must be a positive number, got {value!r}")
    return float(value)


def check_finite(name: str, value: Any) -> float:
    """Return ``value`` as a finite float."""
    if not is_finite(value):
        raise ModelError(f"{name} must be a finite number, got {value!r}")
    return float(value)


def check_flag(name: str, value: Any) -> bool:
    """Return ``value`` as a bool, Python's or NumPy's."""
    if not isinstance(value, bool | np.bool_):
        raise ModelError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def check_random_seed(random_seed: Any) -> np.random.Generator:
    """The random generator of a seed; a generator is returned as it is."""
    try:
        return np.random.default_rng(random_seed)
    except (TypeError, ValueError):
        raise ModelError(
            f"random_seed must be None, an integer that is not negative or a "
            f"numpy.random.Generator, got {random_seed!r}"
        ) from None


def check_ci_prob(ci_prob: float) -> None:
    """Raise a `ModelError` unless it is a probability."""
    if not (isinstance(ci_prob, int | float) and 0 < ci_prob < 1):
        raise ModelError(f"ci_prob must be a number between 0 and 1, got {ci_prob!r}")


def check_floats(name: str, value: Any, ndim: int | None, *, missing: bool = False) -> np.ndarray:
    """Return ``value`` as an array of finite floats; with ``missing``, NaN may stand in it."""
    if np.ma.isMaskedArray(value):
        value = np.ma.filled(np.ma.asarray(value, dtype="float64"), np.nan)
    try:
        if (objects := np.asarray(value)).dtype.kind == "O":
            value = np.where(pd.isna(objects), np.nan, objects)  # NA of pandas is no float
        if objects.dtype.kind == "c":
            raise TypeError  # numpy would leave out the imaginary parts
        # By rows, as compiled code reads it: the numbers of a DataFrame are stored by columns.
        array = np.array(value, dtype="float64", order="C")
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


def shortened(value: Any) -> str:
    """The text of a value on one line, at most 80 characters of it."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else text[:77] + "..."
