"""What DRAM stores of each draw in ``sample_stats``."""

from typing import Any

import numpy as np
from pymc.stats.convergence import SamplerWarning

from pymc_statespace_filters.sampling.kernel.state import (
    ACCEPTANCE,
    FAILURE,
    LOG_DENSITY,
    N_EFFECTIVE,
    N_EVALUATIONS,
    N_FAILED,
    N_SCREEN_FAILED,
    N_SCREENED,
    SCALING,
    STAGE,
    Draws,
)
from pymc_statespace_filters.sampling.target.target import Target

# PyMC's own names: it renames the first "lp", and logs and drops the second.
MODEL_LOGP, WARNING = "model_logp", "warning"


_NUMBERS = {"accept": ACCEPTANCE, MODEL_LOGP: LOG_DENSITY, "scaling": SCALING}
_COUNTS = {
    "stage": STAGE,
    "n_evaluations": N_EVALUATIONS,
    "n_failed": N_FAILED,
    "failure": FAILURE,
}
_SCREEN_COUNTS = {"n_screened": N_SCREENED, "n_screen_failed": N_SCREEN_FAILED}


def dtypes(target: Target) -> dict[str, Any]:
    """Types of the statistics, by name."""
    dim = target.held.dim
    types: dict[str, Any] = dict.fromkeys(_NUMBERS, np.float64) | dict.fromkeys(_COUNTS, np.int64)
    types |= {
        "accept_rate": np.float64,
        # A number, as Metropolis has it: PyMC wants one type for a name in all steps of a model.
        "accepted": np.float64,
        "exact": np.bool_,
        WARNING: SamplerWarning,
    }
    if target.holds_all:  # else another DRAM may have one of another shape, which PyMC refuses
        # A subarray type: the only way to have a matrix per draw stored as numbers.
        types["proposal_cov"] = np.dtype((np.float64, (dim, dim)))
    if target.seed_names:
        types["n_effective"] = np.float64
    if target.moves_noise:  # no seed alone gives the estimate again
        types["correlation"] = np.float64
    else:
        types |= dict.fromkeys(target.seed_names, np.int64)
    if target.screen is not None:
        types |= dict.fromkeys(_SCREEN_COUNTS, np.int64)
    return types


def dtypes_shapes(target: Target) -> dict[str, tuple[Any, Any]]:
    """Types with PyMC's shapes: a scalar, or None for what not every draw has."""
    return {
        name: (dtype, None if name == WARNING else []) for name, dtype in dtypes(target).items()
    }


def of_draws(target: Target, draws: Draws, rows: int | slice) -> dict[str, Any]:
    """Statistics of one iteration, or of several: numbers, or arrays of them.

    Parameters
    ----------
    target : Target
    draws : Draws
    rows : int or slice

    Returns
    -------
    dict
        Without ``accept_rate``, which depends on what came before, and the warning.
    """
    stats = {name: draws.numbers[rows, column] for name, column in _NUMBERS.items()}
    stats |= {name: draws.counts[rows, column] for name, column in _COUNTS.items()}
    stats["accepted"] = (stats["stage"] > 0) * 1.0
    stats["exact"] = np.full(stats["stage"].shape, target.exact)
    if draws.covs.size and target.holds_all:
        stats["proposal_cov"] = draws.covs[rows].copy()
    if target.seed_names:
        stats["n_effective"] = draws.numbers[rows, N_EFFECTIVE]
    if target.moves_noise:
        stats["correlation"] = np.full(stats["stage"].shape, target.settings.correlation)
    else:
        stats |= {name: draws.seeds[rows, i] for i, name in enumerate(target.seed_names)}
    if target.screen is not None:
        stats |= {name: draws.counts[rows, column] for name, column in _SCREEN_COUNTS.items()}
    return stats
