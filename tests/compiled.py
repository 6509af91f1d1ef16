"""Compiled functions of the package, called from Python."""

from collections.abc import Callable
from typing import Any

from numba import njit


def from_python(function: Any) -> Callable:
    """A function that Python can call; those of the package are for compiled functions only."""

    @njit(error_model="numpy")
    def call(*arguments):
        return function(*arguments)

    return call
