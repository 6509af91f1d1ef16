"""The check of a model's filters at the end of a run, with a small part of its time."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pymc.model import Model
from pymc.stats.convergence import SamplerWarning, WarningType
from xarray import DataTree

from ...errors import FilterWarning, StateSpaceFiltersError
from ...filter_checks.checks import check_at_end, doubts, store
from ...filter_checks.finding import EXACT, OFF
from ...filters.protocol import Filter
from ...pymc_model.inspection import observes_state_space
from ...pymc_model.posterior_draws import MIN_DRAWS

# Runs of fewer iterations are trials.
_LEAST_ITERATIONS = 600

_PACKAGE = str(Path(__file__).parents[2])


class FilterCheck(NamedTuple):
    """Sentences about filters that are not off, for the report, and about those that are."""

    said: tuple[str, ...] = ()
    warned: tuple[str, ...] = ()

    def messages(self, level: str) -> list[SamplerWarning]:
        """The sentences of the report."""
        return [SamplerWarning(WarningType.CONVERGENCE, text, level) for text in self.said]


def warn_of_filters(texts: Sequence[str]) -> None:
    """Warn, at the user's call, of filters that are off."""
    for text in texts:
        warnings.warn(text, FilterWarning, skip_file_prefixes=(_PACKAGE,))


def check_filters(
    tree: DataTree,
    model: Model,
    n_iterations: int,
    seconds: float,
    rng: np.random.Generator,
    filter: Filter | None = None,
) -> FilterCheck:
    """Check the filters at the draws of a run that took so many seconds; see `check_filter`.

    The outcome is stored with the draws. ``filter`` is the one that the run has used, if it is not
    that of the model.
    """
    n_draws = tree["posterior"].sizes["draw"]
    if not observes_state_space(model) or n_draws < MIN_DRAWS or n_iterations < _LEAST_ITERATIONS:
        return FilterCheck()
    try:
        outcomes = check_at_end(tree, model, filter, seconds, rng)
    except StateSpaceFiltersError as error:
        return FilterCheck((f"The filter was not checked: {error}",))
    store(tree, outcomes)
    said = [
        f"{name}: {one['verdict']}"
        for name, one in outcomes.items()
        if one["outcome"] not in (OFF, EXACT)  # of an exact one nothing was compared
    ]
    return FilterCheck(tuple(said), tuple(doubts(outcomes)))
