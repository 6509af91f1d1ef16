"""All chains of a run, in threads: who goes on when, what is shown, what is kept on disk.

A chain's thread is in machine code nearly all the time and holds no interpreter lock. It comes back
to Python for the next block of random numbers, and where the main thread has asked for a pause: to
write a checkpoint, or to stop.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from threading import Event
from typing import NamedTuple

import numpy as np
from pymc.stats.convergence import SamplerWarning, log_warnings

from pymc_statespace_filters.sampling import noise_check
from pymc_statespace_filters.sampling.chain_arrays import (
    DONE,
    N_FAILED,
    PAUSE,
    SCALING,
    STAGE,
    Random,
)
from pymc_statespace_filters.sampling.checkpoint import Checkpoint
from pymc_statespace_filters.sampling.progress import watch
from pymc_statespace_filters.sampling.randomness import BLOCK, draw_key, draw_seeds
from pymc_statespace_filters.sampling.running import Halted, RunningChain
from pymc_statespace_filters.sampling.seed_spread import SeedSpread
from pymc_statespace_filters.sampling.target import Target

_REFRESH_SECONDS = 0.1
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

    Attributes
    ----------
    running : RunningChain
    key : ndarray of uint64, shape (2,)
        Of its random numbers.
    seconds : float
        How long it took from start to end; 0 if a checkpoint had begun it.
    """

    def __init__(self, target: Target, plan: Plan, index: int, checkpoint: Checkpoint | None):
        self._target, self._plan, self._index = target, plan, index
        n_covs = plan.tune if plan.keeps_warmup else 0
        self.running = RunningChain(target, plan.n_iterations, n_covs)
        self._rng = np.random.default_rng(plan.seeds[index])
        self.key = draw_key(self._rng)
        self._block: tuple[int, Random] | None = None
        self._log = None if checkpoint is None else checkpoint.log(index)
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
            error.add_note(f"in chain {self._index}, after {self.done} iterations")
            raise

    def seed_spread(self, position: np.ndarray, seeds: np.ndarray) -> SeedSpread:
        """Measure the scatter of the estimates at a point, once the chain has ended."""
        self.running.talk[PAUSE] = 0
        return self.running.seed_spread(position, seeds)

    def progress(self) -> dict[str, float]:
        """What a progress bar shows of the iterations made so far, one at least."""
        draws, done = self.running.draws, self.done
        begin = self._plan.tune if done > self._plan.tune else 0
        counts = draws.counts[done - 1]
        return {
            "accept_rate": float(np.mean(draws.counts[begin:done, STAGE] > 0)),
            "stage": int(counts[STAGE]),
            "scaling": float(draws.numbers[done - 1, SCALING]),
            "n_failed": int(counts[N_FAILED]),
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


def run_chains(
    target: Target,
    plan: Plan,
    *,
    cores: int,
    checkpoint: Checkpoint | None,
    progressbar: bool | str,
) -> list[ChainRun]:
    """Run all chains to their end, or until the user interrupts.

    Parameters
    ----------
    target : Target
        Prepared.
    plan : Plan
    cores : int
        Threads.
    checkpoint : Checkpoint or None
    progressbar : bool or str
        As in ``pm.sample``.

    Returns
    -------
    list of ChainRun
        After an interruption (Ctrl-C) some have made fewer iterations, or none.

    Raises
    ------
    Exception
        What the model raised, with a note that names the chain. The other chains are stopped.
    """
    runs = [ChainRun(target, plan, i, checkpoint) for i in range(len(plan.seeds))]
    stop = Event()
    bars = watch(len(runs), plan.draws, plan.tune, progressbar)
    with bars, ThreadPoolExecutor(cores) as pool:
        futures = [pool.submit(run.run, stop) for run in runs]
        try:
            with suppress(KeyboardInterrupt):
                _watch(runs, futures, bars, stop)
        finally:
            _halt(runs, futures, stop)
    for future in futures:
        if not future.cancelled():
            future.result()
    return runs


def _watch(runs: Sequence[ChainRun], futures: Sequence[Future], bars: watch, stop: Event) -> None:
    """Show how the chains go on and ask for pauses, until all have ended or one has raised."""
    waiting = set(range(len(runs)))
    pending = set(futures)
    while pending:
        ended, pending = wait(pending, timeout=_REFRESH_SECONDS, return_when=FIRST_EXCEPTION)
        for future in ended:
            future.result()
        for i, (run, future) in enumerate(zip(runs, futures, strict=True)):
            run.ask_for_pause(stop)
            if i in waiting and (future.running() or future.done()):
                waiting.remove(i)
                bars.begin(i)
            if run.done > 0:
                bars.update(i, run.done, run.progress(), run.seconds)


def _halt(runs: Sequence[ChainRun], futures: Sequence[Future], stop: Event) -> None:
    """Bring all chains to a halt, however often the user interrupts meanwhile."""
    stop.set()
    for future in futures:
        future.cancel()
    running = {future for future in futures if not future.cancelled()}
    while running:
        with suppress(KeyboardInterrupt):
            for run in runs:
                run.ask_for_pause(stop)
            _, running = wait(running, timeout=_REFRESH_SECONDS)
