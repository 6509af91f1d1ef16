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

from pymc_statespace_filters.sampling import chain
from pymc_statespace_filters.sampling.checkpoint import Checkpoint
from pymc_statespace_filters.sampling.progress import watch
from pymc_statespace_filters.sampling.randomness import BLOCK, draw_key
from pymc_statespace_filters.sampling.running import RunningChain
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
    """

    tune: int
    draws: int
    keeps_warmup: bool
    starts: Sequence[Callable[[np.random.Generator], Sequence[np.ndarray]]]
    seeds: Sequence[np.random.SeedSequence]

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
    """

    def __init__(self, target: Target, plan: Plan, index: int, checkpoint: Checkpoint | None):
        self._target, self._plan, self._index = target, plan, index
        n_covs = plan.tune if plan.keeps_warmup else 0
        self.running = RunningChain(target, plan.n_iterations, n_covs)
        self._rng = np.random.default_rng(plan.seeds[index])
        self._key = draw_key(self._rng)
        self._block: tuple[int, chain.Random] | None = None
        self._log = None if checkpoint is None else checkpoint.log(index)
        if self._log is not None and (stored := self._log.read()) is not None:
            draws, state = stored
            self._key = state.pop("key")
            self.running.restore(draws, state)
        self._n_saved = self.done
        self._saved_at = time.monotonic()

    @property
    def done(self) -> int:
        """Iterations made so far."""
        return int(self.running.talk[chain.DONE])

    def ask_for_pause(self, stop: Event) -> None:
        """Bring the chain back to Python if there is something to do there."""
        if stop.is_set() or self._must_save():
            self.running.talk[chain.PAUSE] = 1

    def run(self, stop: Event) -> None:
        """Go on to the end, or until told to stop."""
        try:
            codes: tuple[int, ...] = ()
            if self.done == 0:
                codes = self.running.start(self._plan.starts[self._index](self._rng), (), self._rng)
            while self.done < self._plan.n_iterations and not stop.is_set():
                self.running.talk[chain.PAUSE] = 0  # asked for again and again where it is needed
                self._advance()
                if codes and self.done > 0:
                    self.running.add_evaluations(codes)
                    codes = ()
                if self._must_save():
                    self._save()
            self._save()
        except Exception as error:
            error.add_note(f"in chain {self._index}, after {self.done} iterations")
            raise

    def progress(self) -> dict[str, float]:
        """What a progress bar shows of the iterations made so far, one at least."""
        draws, done = self.running.draws, self.done
        begin = self._plan.tune if done > self._plan.tune else 0
        counts = draws.counts[done - 1]
        return {
            "accept_rate": float(np.mean(draws.counts[begin:done, chain.STAGE] > 0)),
            "stage": int(counts[chain.STAGE]),
            "scaling": float(draws.numbers[done - 1, chain.SCALING]),
            "n_failed": int(counts[chain.N_FAILED]),
        }

    def _advance(self) -> None:
        """Go on to the end of the block of random numbers, or of the phase."""
        done, plan = self.done, self._plan
        tune = done < plan.tune
        index, first = divmod(done, BLOCK)
        if self._block is None or self._block[0] != index:
            self._block = index, self._target.random(self._key, index)
        end = min((index + 1) * BLOCK, plan.tune if tune else plan.n_iterations)
        self.running.advance(tune, self._block[1], first, done, end - done)

    def _must_save(self) -> bool:
        due = time.monotonic() - self._saved_at >= CHECKPOINT_SECONDS
        return self._log is not None and due and self.done > self._n_saved

    def _save(self) -> None:
        if self._log is not None and self.done > self._n_saved:
            draws, state = self.running.snapshot(self._n_saved)
            self._log.append(draws, state | {"key": self._key})
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
    with bars, ThreadPoolExecutor(cores) as pool, suppress(KeyboardInterrupt):
        futures = [pool.submit(run.run, stop) for run in runs]
        try:
            _watch(runs, futures, bars, stop)
        finally:
            stop.set()
            while any(future.running() for future in futures):
                for run in runs:
                    run.ask_for_pause(stop)
                wait(futures, timeout=_REFRESH_SECONDS)
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
                bars.update(i, run.done, run.progress())
