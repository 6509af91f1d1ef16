"""Whether the likelihood of a run is that of its system: the check of its filters at its end."""

from collections.abc import Sequence

import pymc as pm
import xarray as xr
from pymc.stats.convergence import log_warnings

from ..filter_checks.checks import doubts, kept, store
from ..filters.protocol import Filter
from ..parallel.shared_rows import by_first_rank
from ..parallel.signals import unless_interrupted
from ..sampling.output.filter_check import FilterCheck, check_filters, warn_of_filters
from .output import DoubtsOf
from .request import Request

_CHECK = 2**32 + 2  # key of random numbers beside those of the run


def checked_at_end(model: pm.Model, request: Request, *, progressbar: bool) -> DoubtsOf:
    """Filters are compared with unbiased ones at draws of the result, as at the end of chains."""

    def doubts_of(tree: xr.DataTree, filter: Filter | None, seconds: float) -> Sequence[str]:
        n_particles, rng = request.draws * request.n_populations, request.generator(_CHECK)

        def check() -> FilterCheck:
            return check_filters(tree, model, n_particles, seconds, rng, filter)

        def say() -> Sequence[str]:
            found = unless_interrupted(check, FilterCheck())
            log_warnings(found.messages("info" if progressbar else "debug"))
            warn_of_filters(found.warned)
            return found.warned

        return by_first_rank(say)

    return doubts_of


def kept_from(former: xr.DataTree) -> DoubtsOf:
    """What was found about a filter before further rows, as far as it holds for them, too."""

    def doubts_of(tree: xr.DataTree, filter: Filter | None, seconds: float) -> Sequence[str]:
        assert filter is not None  # of a sequential run
        if not (outcomes := kept(former, filter)):
            return ()
        store(tree, outcomes)
        found = doubts(outcomes)
        warn_of_filters(found)
        return found

    return doubts_of


def not_checked(tree: xr.DataTree, filter: Filter | None, seconds: float) -> Sequence[str]:
    """No doubts, on request."""
    return ()
