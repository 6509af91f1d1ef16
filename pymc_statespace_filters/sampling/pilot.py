"""A short chain that finds where a posterior lies, on noise held fixed.

Held noise makes the target deterministic: no estimate of a point is better than the next one of the
same point, so that the chain moves where one with fresh noise would stand still. What it samples
is the posterior of that one estimate, which is near enough to say where the centre and the tails
are.
"""

from typing import NamedTuple

import numpy as np

from pymc_statespace_filters.sampling.adaptation import start_adaptation
from pymc_statespace_filters.sampling.held_variables import HeldVariables
from pymc_statespace_filters.sampling.log_density import LogDensity
from pymc_statespace_filters.sampling.randomness import take
from pymc_statespace_filters.sampling.settings import DRAMSettings
from pymc_statespace_filters.sampling.starts import Starts, best_start
from pymc_statespace_filters.sampling.transition import EvaluatedPoint, delayed_rejection_move

N_CHAINS, N_TUNE, N_DRAWS = 2, 300, 200

_SETTINGS = DRAMSettings(
    stages=(2, 1),
    stage_scale=0.2,
    adaptation="chain",
    adapt_every=50,
    refresh_noise=False,
)


class Pilot(NamedTuple):
    """Draws of the pilot's chains, different ones only, the highest density first.

    Attributes
    ----------
    positions : ndarray, shape (m, d)
    shares : ndarray, shape (m,)
        For each, the share of all draws that lie no higher.
    """

    positions: np.ndarray
    shares: np.ndarray


def run_pilot(
    log_density: LogDensity,
    held: HeldVariables,
    starts: Starts,
    start: np.ndarray,
    rng: np.random.Generator,
) -> Pilot:
    """Sample the posterior on held noise, in two chains of DRAM.

    Parameters
    ----------
    log_density : LogDensity
        With ``holds_noise=True``, and no variable besides the joined vector.
    held : HeldVariables
    starts : Starts
    start : ndarray, shape (d,)
        Where the chains start, if it is not the model's own starting point.
    rng : numpy.random.Generator

    Returns
    -------
    Pilot
        A chain that has not come near the best point of the other is left out.
    """

    def evaluate(position: np.ndarray, seeds: tuple[np.ndarray, ...] = ()) -> EvaluatedPoint:
        return EvaluatedPoint(position, (), seeds, *log_density(position, (), seeds))

    chains = [_chain(evaluate, held, starts, start, rng) for _ in range(N_CHAINS)]
    best = max(densities.max() for _, densities in chains)
    near = [chain for chain in chains if np.median(chain[1]) > best - held.dim - _FAR]
    positions = np.concatenate([positions for positions, _ in near or chains])
    densities = np.concatenate([densities for _, densities in near or chains])
    _, at, counts = np.unique(densities, return_index=True, return_counts=True)
    shares = np.cumsum(counts) / densities.size
    return Pilot(positions[at[::-1]], shares[::-1])


# A chain whose median lies this many nats, and one for each dimension, below the best point has not
# arrived: the median of a Gaussian posterior lies d / 2 below.
_FAR = 10.0


def _chain(evaluate, held, starts, start, rng) -> tuple[np.ndarray, np.ndarray]:
    """Draws (N_DRAWS, d) and their log-densities (N_DRAWS,) of one chain."""
    current, _ = best_start(starts.candidates(start, rng), evaluate)
    adaptation, batch = start_adaptation(starts.covariance()), None
    positions, densities = np.empty((N_DRAWS, held.dim)), np.empty(N_DRAWS)
    for i in range(-N_TUNE, N_DRAWS):
        batch, share = take(batch, rng, max(_SETTINGS.stages), held.dim, 0)
        n_stages = _SETTINGS.stages[0 if i < 0 else 1]
        move = delayed_rejection_move(
            evaluate,
            current,
            adaptation.chol,
            _SETTINGS.stage_scale,
            share.normals,
            share.log_uniforms,
            [()] * n_stages,
        )
        current = move.point
        if i < 0:
            adaptation = _SETTINGS.adapt(
                _SETTINGS.adaptation_settings, adaptation, current.position, move.stage
            )
        else:
            positions[i], densities[i] = current.position, current.log_density
    return positions, densities
