"""Compiled functions of the package, called from Python."""

from collections.abc import Callable
from typing import Any

from numba import njit

from pymc_statespace_filters.compiler.native.planned_function import PlannedFunction


def from_python(function: Any) -> Callable:
    """A function that Python can call; those of the package are for compiled functions only."""

    @njit(error_model="numpy")
    def call(*arguments):
        return function(*arguments)

    return call


def on_rank(likelihood: PlannedFunction) -> PlannedFunction:
    """The likelihood of a filter for the members of a rank: the last arguments are the rank's."""
    ranks = (("rank", 0), ("n_ranks", 0), ("exchange", 0))
    return PlannedFunction(
        likelihood.plan, (*likelihood.arguments[:-1], ("seed", 0), *ranks), likelihood.results
    )
