"""Where chains start when the user does not say.

PyMC starts every chain of a step method at one point, which hides from R-hat what it is meant to
find. Draws from the prior, on the unconstrained space, disperse the starts; their spread is also
the one thing known about the units of the variables before a chain has moved.
"""

from collections.abc import Callable, Sequence

import numpy as np
from pymc.initial_point import make_initial_point_fn
from pymc.model import Model

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.sampling.health import reason
from pymc_statespace_filters.sampling.held_variables import HeldVariables
from pymc_statespace_filters.sampling.transition import EvaluatedPoint

N_DRAWS = 200


def prior_draws(model: Model, held: HeldVariables) -> np.ndarray:
    """Draw from the prior, on the unconstrained space.

    The seed is fixed, so that the table belongs to the model; a chain's own generator picks from
    it. Where a prior cannot be drawn from (it is flat), the draws are the model's starting point
    plus U(-1, 1), as under PyMC's NUTS.

    Parameters
    ----------
    model : pymc.Model
    held : HeldVariables

    Returns
    -------
    ndarray, shape (n, d)
        Finite rows; there may be fewer than were tried, even none.
    """
    free = list(model.free_RVs)
    from_prior = make_initial_point_fn(model=model, overrides=dict.fromkeys(free, "prior"))
    try:
        points = [from_prior(seed) for seed in range(N_DRAWS)]
    except NotImplementedError:
        jittered = make_initial_point_fn(model=model, jitter_rvs=set(free))
        points = [jittered(seed) for seed in range(N_DRAWS)]
    table = np.array([held.join(point) for point in points])
    return table[np.isfinite(table).all(axis=1)]


def first_covariance(draws: np.ndarray, dim: int) -> np.ndarray:
    """Guess the first proposal covariance: the prior's standard deviations, scaled for d.

    Parameters
    ----------
    draws : ndarray, shape (n, d)
        From ``prior_draws``.
    dim : int
        d.

    Returns
    -------
    ndarray, shape (d, d)
        Diagonal.
    """
    variance = draws.var(axis=0) if len(draws) > 1 else np.ones(dim)
    variance[~(np.isfinite(variance) & (variance > 0.0))] = 1.0
    return np.diag(variance) * 2.38**2 / dim


def starts_in_model(model: Model, held: HeldVariables) -> bool:
    """Tell whether the model itself gives a held variable a starting value (``initval``)."""
    held_rvs = [model.values_to_rvs[v] for v in held.variables]
    return any(model.rvs_to_initial_values[rv] is not None for rv in held_rvs)


def first_possible(
    candidates: Sequence[np.ndarray], evaluate: Callable[[np.ndarray], EvaluatedPoint]
) -> tuple[EvaluatedPoint, tuple[int, ...]]:
    """Take the first candidate of positive density.

    Parameters
    ----------
    candidates : sequence of ndarray, shape (d,)
        The last one is where the chain was told to start.
    evaluate : callable

    Returns
    -------
    EvaluatedPoint
    tuple of int
        For each evaluation made, 0 or the code of its failure.

    Raises
    ------
    ModelError
        If all are impossible.
    """
    codes: tuple[int, ...] = ()
    for position in candidates:
        start = evaluate(position)
        codes = (*codes, start.failure)
        if start.log_density > -np.inf:
            return start, codes
    tried = f", nor at {len(codes) - 1} draws from the prior" if len(codes) > 1 else ""
    because = f" ({reason(codes[-1])})" if codes[-1] else ""
    raise ModelError(
        f"the log-density is not finite at the start, {candidates[-1].tolist()} on the "
        f"unconstrained space{because}{tried}: give a possible starting point in initvals"
    )
