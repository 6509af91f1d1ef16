"""What DRAM stores of each draw in ``sample_stats``."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from pymc.stats.convergence import SamplerWarning

from pymc_statespace_filters.sampling.adaptation import AdaptationState
from pymc_statespace_filters.sampling.transition import Move

# PyMC's own names: it renames the first "lp", and logs and drops the second.
MODEL_LOGP, WARNING = "model_logp", "warning"


def dtypes(dim: int, seed_names: Sequence[str]) -> dict[str, Any]:
    """Types of the statistics, by name, for d = ``dim`` and the given noise seeds."""
    return {
        "accept": np.float64,
        "accept_rate": np.float64,
        # A number, as Metropolis has it: PyMC wants one type for a name in all steps of a model.
        "accepted": np.float64,
        "stage": np.int64,
        MODEL_LOGP: np.float64,
        "scaling": np.float64,
        "n_evaluations": np.int64,
        "n_failed": np.int64,
        "failure": np.int64,
        # A subarray type: the only way to have a matrix per draw stored as numbers.
        "proposal_cov": np.dtype((np.float64, (dim, dim))),
        "exact": np.bool_,
        WARNING: SamplerWarning,
    } | (dict.fromkeys(seed_names, np.int64) | {"n_effective": np.float64} if seed_names else {})


def dtypes_shapes(dim: int, seed_names: Sequence[str]) -> dict[str, tuple[Any, Any]]:
    """Types with PyMC's shapes: a scalar, or None for what not every draw has."""
    return {
        name: (dtype, None if name == WARNING else [])
        for name, dtype in dtypes(dim, seed_names).items()
    }


def of_draw(
    move: Move,
    codes: Sequence[int],
    *,
    seed_names: Sequence[str],
    exact: bool,
    accept_rate: float,
    adaptation: AdaptationState,
    warning: SamplerWarning | None,
) -> dict[str, Any]:
    """Statistics of one draw.

    Parameters
    ----------
    move : Move
    codes : sequence of int
        Failure code (0: none) of every evaluation that the draw took.
    seed_names : sequence of str
    exact : bool
        Whether the chain's target is the posterior itself, without the bias of a filter's noise.
    accept_rate : float
    adaptation : AdaptationState
        As it was when the move was made.
    warning : SamplerWarning, optional

    Returns
    -------
    dict
    """
    failed = [code for code in codes if code]
    stats = {
        "accept": move.acceptance,
        "accept_rate": accept_rate,
        "accepted": float(move.stage > 0),
        "stage": move.stage,
        MODEL_LOGP: move.point.log_density,
        # The geometric mean of the standard deviations along the axes of the proposal.
        "scaling": math.prod(adaptation.chol.diagonal().tolist()) ** (1.0 / len(adaptation.chol)),
        "n_evaluations": len(codes),
        "n_failed": len(failed),
        "failure": failed[-1] if failed else 0,
        "proposal_cov": adaptation.cov,
        "exact": exact,
        WARNING: warning,
    }
    if seed_names:
        stats["n_effective"] = move.point.n_effective
        stats.update(zip(seed_names, move.point.seeds, strict=True))
    return stats
