"""Whether the likelihood of a run is that of its system: the check of its filters at its end."""

from collections.abc import Sequence

import pymc as pm
import xarray as xr

from ..checks.filters.checks import kept, store
from ..checks.filters.filter_facts import FilterOutcomes, UsedFilters
from ..facts import tell
from ..filters.protocol import Filter
from ..parallel.shared_rows import by_first_rank
from .output import DoubtsOf
from .particle_request import Request

_CHECK = 2**32 + 2  # key of random numbers beside those of the run


def checked_at_end(model: pm.Model, request: Request, *, progressbar: bool) -> DoubtsOf:
    """Filters are compared with unbiased ones at draws of the result, as at the end of chains."""

    def doubts_of(tree: xr.DataTree, filter: Filter | None, seconds: float) -> Sequence[str]:
        n_particles, rng = request.draws * request.n_populations, request.generator(_CHECK)
        level = "info" if progressbar else "debug"
        fact = UsedFilters(tree, model, n_particles, seconds, rng, filter, level)
        return by_first_rank(lambda: tell(fact))

    return doubts_of


def kept_from(former: xr.DataTree) -> DoubtsOf:
    """What was found about a filter before further rows, as far as it holds for them, too."""

    def doubts_of(tree: xr.DataTree, filter: Filter | None, seconds: float) -> Sequence[str]:
        assert filter is not None  # of a sequential run
        if not (outcomes := kept(former, filter)):
            return ()
        store(tree, outcomes)
        return tell(FilterOutcomes(outcomes))

    return doubts_of


def not_checked(tree: xr.DataTree, filter: Filter | None, seconds: float) -> Sequence[str]:
    """No doubts, on request."""
    return ()
