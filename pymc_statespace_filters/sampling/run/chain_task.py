"""A chain from its start to its end, in a thread of its own, and what is kept of it on disk.

The thread is in machine code nearly all the time and holds no interpreter lock. It comes back to
Python for the next block of random numbers, and where the main thread has asked for a pause: to
write a checkpoint, or to stop.
"""

import time
from collections.abc import Callable, Sequence
from threading import Event
from typing import NamedTuple

import numpy as np
from pymc.stats.convergence import SamplerWarning, log_warnings

from pymc_statespace_filters.sampling.checkpoint.checkpoint import Checkpoint
from pymc_statespace_filters.sampling.kernel.random_numbers import BLOCK, draw_key, draw_seeds
from pymc_statespace_filters.sampling.kernel.state import (
    DONE,
    N_FAILED,
    PAUSE,
    STAGE,
    Draws,
    Random,
)
from pymc_statespace_filters.sampling.output import noise_check
from pymc_statespace_filters.sampling.run.chain import Halted, RunningChain
from pymc_statespace_filters.sampling.target.target import Target

CHECKPOINT_SECONDS = 5.0


class Plan(NamedTuple):
    """What a run is to do.

    Attributes
    ----------
    tune, draws : int
        Iterations of each chain.
    keeps_warmup : bool
    starts : sequence of callable
        For each chain, from its generator to the candidates for its start.
    seeds : sequence of numpy.random.SeedSequence
        For each chain, all its randomness.
    measures_noise : bool
        Whether the scatter of the estimates is measured at each start.
    """

    tune: int
    draws: int
    keeps_warmup: bool
    starts: Sequence[Callable[[np.random.Generator], Sequence[np.ndarray]]]
    seeds: Sequence[np.random.SeedSequence]
    measures_noise: bool = False

    @property
    def n_iterations(self) -> int:
        """Iterations of a chain."""
        return self.tune + self.draws


class ChainResult(NamedTuple):
    """What is left of a chain at its end.

    Attributes
    ----------
    draws : Draws
        Of ``done`` iterations.
    done : int
        Fewer than were planned after an interruption.
    key : ndarray of uint64, shape (2,)
    proposal_cov : ndarray, shape (d, d)
        Of the first stage, as it was last.
    seconds : float
    """

    draws: Draws
    done: int
    key: np.ndarray
    proposal_cov: np.ndarray
    seconds: float


class ChainRun:
    """One chain from its start, or from its checkpoint, to its end.

    Parameters
    ----------
    target : Target
        Prepared.
    plan : Plan
    index : int
        Which chain.
    checkpoint : Checkpoint, optional
    name : str, optional
        For messages.

    Attributes
    ----------
    running : RunningChain
    key : ndarray of uint64, shape (2,)
        Of its random numbers.
    seconds : float
        How long it took from start to end; 0 if a checkpoint had begun it.
    """

    def __init__(
        self,
        target: Target,
        plan: Plan,
        index: int,
        checkpoint: Checkpoint | None,
        name: str | None = None,
    ):
        self._target, self._plan, self._index = target, plan, index
        self._name = name or f"chain {index}"
        n_covs = plan.tune if plan.keeps_warmup else 0
        self.running = RunningChain(target, plan.n_iterations, n_covs)
        self._rng = np.random.default_rng(plan.seeds[index])
        self.key = draw_key(self._rng)
        self._block: tuple[int, Random] | None = None
        self._log = None if checkpoint is None else checkpoint.journal(index)
        if self._log is not None and (stored := self._log.read()) is not None:
            draws, state = stored
            self.key = state.pop("key")
            self.running.restore(draws, state)
        self._n_saved = self.done
        self._saved_at = time.monotonic()
        self.seconds = 0.0
        self._start_warning: SamplerWarning | None = None

    @property
    def done(self) -> int:
        """Iterations made so far."""
        return int(self.running.talk[DONE])

    def ask_for_pause(self, stop: Event) -> None:
        """Bring the chain back to Python if there is something to do there."""
        if stop.is_set() or self._must_save():
            self.running.talk[PAUSE] = 1

    def run(self, stop: Event) -> None:
        """Go on to the end, or until told to stop."""
        began, resumed = time.monotonic(), self.done > 0
        try:
            codes = self._start() if self.done == 0 else ()
            while self.done < self._plan.n_iterations and not stop.is_set():
                self.running.talk[PAUSE] = 0  # asked for again and again where it is needed
                self._advance()
                if codes and self.done > 0:
                    self.running.add_evaluations(codes)
                    codes = ()
                self._warn_if_still_there()
                if self._must_save():
                    self._save()
            self._save()
            self.seconds = 0.0 if resumed else time.monotonic() - began
        except Halted:
            return
        except Exception as error:
            error.add_note(f"in {self._name}, after {self.done} iterations")
            raise

    def result(self) -> ChainResult:
        """What is left of the chain; its machine code goes."""
        done = self.done
        cut = {
            name: array if name == "covs" else array[:done]
            for name, array in self.running.draws._asdict().items()
        }
        cov = self.running.proposal_cov.copy()
        return ChainResult(Draws(**cut), done, self.key, cov, self.seconds)

    def progress(self) -> dict[str, float]:
        """What a progress bar shows of the iterations made so far, one at least."""
        draws, done = self.running.draws, self.done
        begin = self._plan.tune if done > self._plan.tune else 0
        return {
            "accept_rate": float(np.mean(draws.counts[begin:done, STAGE] > 0)),
            "n_failed": int(draws.counts[done - 1, N_FAILED]),
        }

    def _start(self) -> tuple[int, ...]:
        """Find a start; for each evaluation made, 0 or the code of its failure."""
        candidates = self._plan.starts[self._index](self._rng)
        codes = self.running.start(candidates, (), self._rng)
        if self._plan.measures_noise:
            state = self.running.state
            seeds = draw_seeds(self._rng, (noise_check.N_SEEDS, state.seeds.size))
            spread = self.running.seed_spread(state.position, seeds)
            self._start_warning = noise_check.start_warning(spread, self._index)
        return codes

    def _warn_if_still_there(self) -> None:
        """Say that the start is too noisy, unless the chain has left it: most do, uphill."""
        if self._start_warning is not None and self.done >= noise_check.STILL:
            if not self.running.draws.counts[: noise_check.STILL, STAGE].any():
                log_warnings([self._start_warning])
            self._start_warning = None

    def _advance(self) -> None:
        """Go on to the end of the block of random numbers, or of the phase."""
        done, plan = self.done, self._plan
        tune = done < plan.tune
        index, first = divmod(done, BLOCK)
        if self._block is None or self._block[0] != index:
            self._block = index, self._target.random(self.key, index)
        end = min((index + 1) * BLOCK, plan.tune if tune else plan.n_iterations)
        self.running.advance(tune, self._block[1], first, done, end - done)

    def _must_save(self) -> bool:
        due = time.monotonic() - self._saved_at >= CHECKPOINT_SECONDS
        return self._log is not None and due and self.done > self._n_saved

    def _save(self) -> None:
        if self._log is not None and self.done > self._n_saved:
            draws, state = self.running.snapshot(self._n_saved)
            self._log.append(draws, state | {"key": self.key})
            self._n_saved = self.done
        self._saved_at = time.monotonic()
