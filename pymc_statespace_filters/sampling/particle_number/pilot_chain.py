"""A short chain with fixed noise, which finds where a posterior lies.

Fixed noise makes the target deterministic, so that the chain cannot stay at an overestimate as one
with fresh noise would. It samples the posterior of that one estimate, which is close enough to
locate the centre and the tails.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...parallel.cpu_affinity import available_cores
from ..kernel.independence import no_mixture
from ..kernel.state import LOG_DENSITY
from ..run.chain_task import ChainTask
from ..run.thread_pool import ChainPool
from ..target.settings import RandomWalkSettings
from ..target.target import Target
from .effort import Effort

N_CHAINS, N_TUNE, N_DRAWS = 2, 300, 200

# A chain whose median density is this many nats plus one per dimension below the best point has not
# converged: the median of a Gaussian posterior is about d / 2 below.
_FAR = 10.0

_FEWEST = 25  # iterations, if the time runs short

SETTINGS = RandomWalkSettings(adapt_every=50, refresh_noise=False)


class Pilot(NamedTuple):
    """Distinct draws of the pilot's chains, the highest density first."""

    positions: np.ndarray  # (m, d)
    fractions: np.ndarray  # (m,), of all draws, those whose density is no higher
    n_iterations: int  # of the shortest chain

    @property
    def is_complete(self) -> bool:
        """Whether all chains have reached their end."""
        return self.n_iterations == N_TUNE + N_DRAWS


def pilot_chains(
    target: Target, start: np.ndarray, rng: np.random.Generator
) -> Sequence[ChainTask]:
    """Two chains of DRAM with `SETTINGS`, which sample the posterior with fixed noise.

    They begin at ``start``, shape (d,), unless it is the model's initial point.
    """
    target.prepare()
    entropy = rng.integers(2**32, size=4).tolist()
    return [
        ChainTask(
            target,
            N_TUNE,
            N_TUNE + N_DRAWS,
            lambda rng: target.prior_draws.candidates(start, rng),
            seed,
            n_rows=N_TUNE + N_DRAWS,
            mixture=no_mixture(target.raveled.dim),
            index=i,
        )
        for i, seed in enumerate(np.random.SeedSequence(entropy).spawn(N_CHAINS))
    ]


def run_pilot(tasks: Sequence[ChainTask], effort: Effort, share: float) -> Pilot:
    """Run the chains; a chain that has not come near the best point of the other is left out.

    A compilation has begun, which ends with their first iteration. When this ``share`` of the limit
    in seconds has passed the chains are cut, and the second half of what they have made is used.
    """
    _run(tasks, effort, share)
    n_done = [task.n_done for task in tasks]
    tune = min(N_TUNE, min(n_done) // 2)
    draws = [task.result()[0] for task in tasks]
    chains = [(d.positions[tune:], d.numbers[tune:, LOG_DENSITY]) for d in draws]
    best = max(densities.max() for _, densities in chains)
    near = [chain for chain in chains if np.median(chain[1]) > best - chain[0].shape[1] - _FAR]
    positions = np.concatenate([positions for positions, _ in near or chains])
    densities = np.concatenate([densities for _, densities in near or chains])
    _, at, counts = np.unique(densities, return_index=True, return_counts=True)
    fractions = np.cumsum(counts) / densities.size
    return Pilot(positions[at[::-1]], fractions[::-1], min(n_done))


def _run(tasks: Sequence[ChainTask], effort: Effort, share: float) -> None:
    """Run the chains to their end, or until the time runs short."""
    reported, waiting = 0, dict(enumerate(tasks))
    with ChainPool(min(N_CHAINS, available_cores())) as pool:
        while waiting or pool.running:
            while waiting and pool.is_idle:
                pool.start(*waiting.popitem())
            pool.finished()
            n_done = [task.n_done for task in tasks]
            if reported == 0 < sum(n_done):
                effort.end_compilation()
                effort.announce("Pilot chains", N_CHAINS * (N_TUNE + N_DRAWS))
            if sum(n_done) > reported:
                effort.on_progress(sum(n_done) - reported)
                reported = sum(n_done)
            if not effort.has_left(share) and min(n_done) >= _FEWEST:
                break
