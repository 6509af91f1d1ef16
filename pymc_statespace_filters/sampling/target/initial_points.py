"""Where chains start when the user does not say.

PyMC starts every chain of a step method at one point, which hides from R-hat what it is meant to
find. Draws from the prior, on the unconstrained space, disperse the starts; their spread is also
the one thing known about the units of the variables before a chain has moved.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from pymc.initial_point import make_initial_point_fn
from pymc.model import Model

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.sampling.output.warnings import reason
from pymc_statespace_filters.sampling.target.variables import HeldVariables

N_DRAWS = 200
# Possible prior draws of which a chain starts at the best.
N_COMPARED = 10


class EvaluatedPoint(NamedTuple):
    """A point with its estimate.

    Attributes
    ----------
    position : ndarray, shape (d,)
        On the unconstrained space.
    seeds : ndarray of int64, shape (noisy,)
        The noise behind the estimate.
    log_density : float
    failure : int
        0, or the code of the reason why the log-density is minus infinity.
    n_effective : float
        Smallest effective number of particles behind the estimate; infinity if it has no noise.
    log_screen : float
        Log-density of the screen, 0 without one.
    """

    position: np.ndarray
    seeds: np.ndarray
    log_density: float
    failure: int
    n_effective: float = np.inf
    log_screen: float = 0.0


class Starts:
    """The prior's draws, and whether a start has been chosen by the user.

    PyMC does not hand ``initvals`` to a step method; a start that differs from the model's own
    starting point, or an ``initval`` in the model, gives the choice away. (Somebody who passes
    exactly the model's starting point is not recognised.)

    Parameters
    ----------
    model : pymc.Model
    held : HeldVariables
    default : mapping of str to ndarray
        The model's own starting point.
    """

    def __init__(self, model: Model, held: HeldVariables, default: Mapping[str, np.ndarray]):
        held_rvs = [model.values_to_rvs[v] for v in held.variables]
        self._in_model = any(model.rvs_to_initial_values[rv] is not None for rv in held_rvs)
        self._default = held.join(default)
        self._draws = _prior_draws(model, held)

    def candidates(self, start: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
        """List where a chain may start: draws from the prior before the point it was told.

        Parameters
        ----------
        start : ndarray, shape (d,)
            Where the chain was told to start.
        rng : numpy.random.Generator

        Returns
        -------
        list of ndarray, shape (d,)
            Only ``start`` itself if the user chose it.
        """
        if self._in_model or not np.array_equal(start, self._default):
            return [start]
        return [*rng.permutation(self._draws), start]

    def covariance(self) -> np.ndarray:
        """Guess a first proposal covariance: the prior's variances times 2.38^2 / d, diagonal."""
        dim = self._default.size
        variance = self._draws.var(axis=0) if len(self._draws) > 1 else np.ones(dim)
        variance[~(np.isfinite(variance) & (variance > 0.0))] = 1.0
        return np.diag(variance) * 2.38**2 / dim


def _prior_draws(model: Model, held: HeldVariables) -> np.ndarray:
    """Draw from the prior, on the unconstrained space: finite rows, shape (n, d).

    The seed is fixed, so that the table belongs to the model; a chain's own generator picks from
    it. Where a prior cannot be drawn from (it is flat), the draws are the model's starting point
    plus U(-1, 1), as under PyMC's NUTS.
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


def best_start(
    candidates: Sequence[np.ndarray], evaluate: Callable[[np.ndarray], EvaluatedPoint]
) -> tuple[EvaluatedPoint, tuple[int, ...]]:
    """Take the best of the first few candidates of positive density.

    Far out in the prior an estimated likelihood is a matter of luck, and a chain that begins at a
    lucky estimate stays there; a few more draws lie better and are still dispersed.

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
    possible: list[EvaluatedPoint] = []
    for position in candidates:
        start = evaluate(position)
        codes = (*codes, start.failure)
        if start.log_density > -np.inf:
            possible.append(start)
        if len(possible) == N_COMPARED:
            break
    if possible:
        return max(possible, key=lambda start: start.log_density), codes
    tried = f", nor at {len(codes) - 1} draws from the prior" if len(codes) > 1 else ""
    because = f" ({reason(codes[-1])})" if codes[-1] else ""
    raise ModelError(
        f"the log-density is not finite at the start, {candidates[-1].tolist()} on the "
        f"unconstrained space{because}{tried}: give a possible starting point in initvals, or a "
        "pilot to sample_dram whose chains end at possible points"
    )
