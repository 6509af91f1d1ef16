"""Checks of a filter's settings, made once when the filter is constructed."""

from collections.abc import Iterable
from numbers import Real

import numpy as np

from ..errors import ModelError
from ..system.checks import is_integer

MOST_MEMBERS = 10**8


def check_count(name: str, value: object) -> int:
    """Return ``value`` as an int of at least 2, of which the memory may hold the states."""
    if not is_integer(value) or not 2 <= value <= MOST_MEMBERS:
        raise ModelError(f"{name} must be an integer from 2 to {MOST_MEMBERS:.0e}, got {value!r}.")
    return int(value)


def check_fraction(name: str, value: object) -> float:
    """Return ``value`` as a float between 0 and 1."""
    is_real = isinstance(value, Real) and not isinstance(value, bool | np.bool_)
    if not is_real or not 0.0 <= float(value) <= 1.0:  # type: ignore[arg-type]
        raise ModelError(f"{name} must be a number from 0 to 1, got {value!r}.")
    return float(value)  # type: ignore[arg-type]


def check_choice(name: str, value: object, allowed: Iterable[str]) -> None:
    """Raise unless ``value`` is one of the allowed words."""
    words = list(allowed)
    if not isinstance(value, str) or value not in words:
        listed = ", ".join(repr(word) for word in words)
        raise ModelError(f"{name} must be one of {listed}, got {value!r}.")
