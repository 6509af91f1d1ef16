"""Filters at the end of a calculation: to be checked, or known to be off."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pymc.model import Model
from xarray import DataTree

from ...facts import Fact
from ...filters.protocol import Filter


@dataclass(frozen=True)
class UsedFilters(Fact):
    """The filters of a calculation of so many iterations and seconds, with its draws.

    ``filter`` is the one that it has used, if it is not that of the model; ``level`` is that of
    what is said of filters that are not off.
    """

    tree: DataTree
    model: Model
    n_iterations: int
    seconds: float
    rng: np.random.Generator
    filter: Filter | None
    level: str


@dataclass(frozen=True)
class FilterOutcomes(Fact):
    """The outcomes of an earlier check, for all variables; see `filter_checks.checks`."""

    outcomes: Mapping[str, Mapping[str, str]]
