"""A short chain that finds where a posterior lies, on noise held fixed.

Held noise makes the target deterministic: no estimate of a point is better than the next one of the
same point, so that the chain moves where one with fresh noise would stand still. What it samples
is the posterior of that one estimate, which is near enough to say where the centre and the tails
are.
"""

from threading import Event
from typing import NamedTuple

import numpy as np

from pymc_statespace_filters.sampling.kernel.state import LOG_DENSITY
from pymc_statespace_filters.sampling.run.chain_task import ChainRun, Plan
from pymc_statespace_filters.sampling.target.settings import DRAMSettings
from pymc_statespace_filters.sampling.target.target import Target

N_CHAINS, N_TUNE, N_DRAWS = 2, 300, 200

SETTINGS = DRAMSettings(adapt_every=50, refresh_noise=False)


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


def run_pilot(target: Target, start: np.ndarray, rng: np.random.Generator) -> Pilot:
    """Sample the posterior on held noise, in two chains of DRAM.

    Parameters
    ----------
    target : Target
        With `SETTINGS`.
    start : ndarray, shape (d,)
        Where the chains start, if it is not the model's own starting point.
    rng : numpy.random.Generator

    Returns
    -------
    Pilot
        A chain that has not come near the best point of the other is left out.
    """
    target.prepare()
    entropy = rng.integers(2**32, size=4).tolist()
    plan = Plan(
        N_TUNE,
        N_DRAWS,
        False,
        [lambda rng: target.starts.candidates(start, rng)] * N_CHAINS,
        np.random.SeedSequence(entropy).spawn(N_CHAINS),
    )
    chains = []
    for i in range(N_CHAINS):
        run = ChainRun(target, plan, i, None)
        run.run(Event())
        draws = run.running.draws
        chains.append((draws.positions[N_TUNE:], draws.numbers[N_TUNE:, LOG_DENSITY]))
    best = max(densities.max() for _, densities in chains)
    near = [chain for chain in chains if np.median(chain[1]) > best - target.held.dim - _FAR]
    positions = np.concatenate([positions for positions, _ in near or chains])
    densities = np.concatenate([densities for _, densities in near or chains])
    _, at, counts = np.unique(densities, return_index=True, return_counts=True)
    shares = np.cumsum(counts) / densities.size
    return Pilot(positions[at[::-1]], shares[::-1])


# A chain whose median lies this many nats, and one for each dimension, below the best point has not
# arrived: the median of a Gaussian posterior lies d / 2 below.
_FAR = 10.0
