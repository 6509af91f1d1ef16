"""A short chain with fixed noise, which finds where a posterior lies.

Fixed noise makes the target deterministic, so that the chain cannot stay at an overestimate as one
with fresh noise would. It samples the posterior of that one estimate, which is close enough to
locate the centre and the tails.
"""

from threading import Event
from typing import NamedTuple

import numpy as np

from pymc_statespace_filters.sampling.kernel.independence import no_mixture
from pymc_statespace_filters.sampling.kernel.state import LOG_DENSITY
from pymc_statespace_filters.sampling.run.chain_task import ChainTask
from pymc_statespace_filters.sampling.target.settings import DRAMSettings
from pymc_statespace_filters.sampling.target.target import Target

N_CHAINS, N_TUNE, N_DRAWS = 2, 300, 200

# A chain whose median density is this many nats plus one per dimension below the best point has not
# converged: the median of a Gaussian posterior is about d / 2 below.
_FAR = 10.0

SETTINGS = DRAMSettings(adapt_every=50, refresh_noise=False)


class Pilot(NamedTuple):
    """Distinct draws of the pilot's chains, the highest density first."""

    positions: np.ndarray  # (m, d)
    fractions: np.ndarray  # (m,), of all draws, those whose density is no higher


def run_pilot(target: Target, start: np.ndarray, rng: np.random.Generator) -> Pilot:
    """Sample the posterior with fixed noise, by two chains of DRAM with `SETTINGS`.

    They begin at ``start``, shape (d,), unless it is the model's initial point. A chain that has
    not come near the best point of the other is left out.
    """
    target.prepare()
    entropy = rng.integers(2**32, size=4).tolist()
    chains = []
    for i, seed in enumerate(np.random.SeedSequence(entropy).spawn(N_CHAINS)):
        task = ChainTask(
            target,
            N_TUNE,
            N_TUNE + N_DRAWS,
            lambda rng: target.prior_draws.candidates(start, rng),
            seed,
            n_rows=N_TUNE + N_DRAWS,
            mixture=no_mixture(target.raveled.dim),
            index=i,
        )
        task.run(Event())
        draws, _ = task.result()
        chains.append((draws.positions[N_TUNE:], draws.numbers[N_TUNE:, LOG_DENSITY]))
    best = max(densities.max() for _, densities in chains)
    near = [chain for chain in chains if np.median(chain[1]) > best - target.raveled.dim - _FAR]
    positions = np.concatenate([positions for positions, _ in near or chains])
    densities = np.concatenate([densities for _, densities in near or chains])
    _, at, counts = np.unique(densities, return_index=True, return_counts=True)
    fractions = np.cumsum(counts) / densities.size
    return Pilot(positions[at[::-1]], fractions[::-1])
