"""What an evidence or a correction asks about its draws and filters; `advice` has the words."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pymc.model import Model
from xarray import DataTree

from ..facts import Fact
from ..filters.protocol import Filter
from .posterior import Posterior


@dataclass(frozen=True)
class FiltersOfDraws(Fact):
    """The filters of a model as those of its draws were found to be."""

    idata: DataTree
    model: Model


@dataclass(frozen=True)
class PartsOfPosterior(Fact):
    """Draws that may lack parts of their posterior, if that was not looked at before.

    Sorted draws are others than those that were looked at.
    """

    idata: DataTree
    model: Model
    posterior: Posterior
    rng: np.random.Generator
    are_sorted: bool = False


@dataclass(frozen=True)
class CorrectingFilter(Fact):
    """The filter that replaces those of a model, at draws (m, k), or at those of a result.

    The result keeps what is found. The correction has taken so many CPU seconds.
    """

    draws: DataTree | NDArray[np.float64]
    model: Model
    filter: Filter
    seconds: float
    rng: np.random.Generator
