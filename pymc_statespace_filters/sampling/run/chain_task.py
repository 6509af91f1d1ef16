"""A chain run from its start, or from its checkpoint, to its end, in one thread.

The thread spends nearly all its time in machine code, without the interpreter lock. It returns to
Python for the next block of random numbers, and when the main thread has requested a pause: to
write a checkpoint, or to stop.
"""

import time
from collections.abc import Callable, Sequence
from threading import Event

import numpy as np

from ...facts import tell
from ..checkpoint.arrays import Arrays, Stored
from ..kernel.state import (
    N_DONE,
    N_FAILED,
    PAUSE_REQUESTED,
    STAGE,
    ChainState,
    Draws,
    draw_key,
    draw_seeds,
    n_accepted,
)
from ..output.facts import NoisyStart
from ..output.likelihood_variance import N_SEEDS, N_STUCK
from ..target.record_target import RecordTarget
from ..target.target import Target
from .chain_arrays import StopRequested
from .record_chain import chain_of
from .thinned_draws import Thinning

CHECKPOINT_SECONDS = 5.0

Candidates = Callable[[np.random.Generator], Sequence[np.ndarray]]
Store = Callable[[Arrays, Arrays], None]  # of new draws, and the state after them


class ChainTask:
    """One chain to be run.

    Parameters
    ----------
    target : Target or RecordTarget
        Prepared.
    tune : int
    n_iterations : int
        Iterations after which the chain ends; `extend` gives it more.
    candidates : callable
        From the chain's generator to the candidates for its start.
    seed : numpy.random.SeedSequence
        The chain's randomness.
    n_rows : int
        Draws, with those of the warm-up, that it may have after `extend`.
    thin : int
        Iterations after the warm-up of which one draw, the last, is kept.
    mixture : ndarray
        Packed, of the first proposals.
    proposal_cov : ndarray, optional
        Of the first proposals. Default: the target's.
    index : int
        Number of the chain.
    name : str, optional
        For messages. Default: "chain" and the index.
    stored : Stored, optional
        What a former call has stored of the chain.
    store : callable, optional
        Stores new draws and the state after them.
    keeps_warmup : bool
    measures_noise : bool
        Whether the variance of the estimated log-likelihood is measured at the start.
    former : (ChainState, int), optional
        The state of a chain that is to go on, and the number of its iterations.
    """

    def __init__(
        self,
        target: Target | RecordTarget,
        tune: int,
        n_iterations: int,
        candidates: Candidates,
        seed: np.random.SeedSequence,
        *,
        n_rows: int,
        mixture: np.ndarray,
        thin: int = 1,
        proposal_cov: np.ndarray | None = None,
        index: int = 0,
        name: str | None = None,
        stored: Stored | None = None,
        store: Store | None = None,
        keeps_warmup: bool = False,
        measures_noise: bool = False,
        former: tuple[ChainState, int] | None = None,
    ):
        self._tune, self._n_iterations = tune, n_iterations
        self._candidates, self._measures_noise = candidates, measures_noise
        self._n_noisy = len(target.seed_names)
        self._index, self._name = index, name or f"chain {index}"
        self._rng = np.random.default_rng(seed)
        n_covs = tune if keeps_warmup else 0
        # Pages of these arrays that are never written to take no memory.
        self._target = target
        self.chain = chain_of(
            target, draw_key(self._rng), n_rows, n_covs, proposal_cov, Thinning(tune, thin)
        )
        self.chain.state.mixture[:] = mixture
        self._first, self._goes_on = 0, former is not None
        if former is not None:
            state, self._first = former
            self.chain.load_state(state)
        self._store = store
        if stored is not None:
            self.chain.restore(*stored)
        self._n_saved = self.n_done
        self._is_resumed = self.n_done > 0
        self._saved_at = time.monotonic()
        self.seconds = 0.0  # duration of a finished chain; 0 if it was resumed from a checkpoint
        self._noisy_start: NoisyStart | None = None

    @property
    def n_done(self) -> int:
        """Iterations made so far."""
        return int(self.chain.control[N_DONE])

    @property
    def positions(self) -> np.ndarray:
        """Draws made so far, after the warm-up, shape (n, d)."""
        return self.chain.draws.positions[self._tune : self._n_rows]

    @property
    def _n_rows(self) -> int:
        """Draws of the iterations made so far, with those of the warm-up."""
        return self.chain.thinning.n_rows(min(self.n_done, self._n_iterations))

    def extend(self, n_iterations: int, thin: int, mixture: np.ndarray) -> None:
        """Let the chain, which has ended, run again, until it has made so many iterations.

        Of more of them, one is kept from now on. A chain from a checkpoint that is further has this
        mixture, or a later one.
        """
        if thin > self.chain.thinning.every:
            self.chain.coarsen(thin)
        if self.n_done == self._n_iterations:
            self.chain.state.mixture[:] = mixture
        self._n_iterations = n_iterations

    def request_pause(self, stop: Event) -> None:
        """Have the chain return to Python if it is to stop or to be saved."""
        if stop.is_set() or self._must_save():
            self.chain.control[PAUSE_REQUESTED] = 1

    def run(self, stop: Event) -> None:
        """Run to the end, or until the event is set."""
        began = time.monotonic()
        try:
            failures = () if self._goes_on or self.n_done > 0 else self._start()
            while self.n_done < self._n_iterations and not stop.is_set():
                self.chain.control[PAUSE_REQUESTED] = 0  # the main thread repeats its request
                self._advance()
                if failures and self.n_done > 0:
                    self.chain.add_evaluations(failures)
                    failures = ()
                self._warn_if_stuck()
                if self._must_save():
                    self._save()
            self._save()
            self.seconds = 0.0 if self._is_resumed else self.seconds + time.monotonic() - began
        except StopRequested:
            return
        except Exception as error:
            error.add_note(f"in {self._name}, after {self.n_done} iterations")
            raise

    def result(self) -> tuple[Draws, ChainState]:
        """Draws of the iterations made, and the state after them, without the machine code.

        A chain from a checkpoint may be longer than it has to be so far: it is cut.
        """
        draws = {
            name: array if name == "covs" else array[: self._n_rows]
            for name, array in self.chain.draws._asdict().items()
        }
        state = self.chain.state._replace(carried=np.empty(0))  # as long as the record
        return Draws(**draws), ChainState(*(array.copy() for array in state))

    def progress(self) -> dict[str, float]:
        """Statistics for a progress bar, after at least one iteration."""
        draws, thinning = self.chain.draws, self.chain.thinning
        end = thinning.n_rows(self.n_done)
        begin = self._tune if end > self._tune else 0
        n = thinning.n_iterations(end) - begin
        return {
            "accept_rate": float(n_accepted(draws.counts[begin:end]).mean(axis=1).sum() / n),
            "n_failed": int(draws.counts[end - 1, N_FAILED]),
        }

    def _start(self) -> tuple[int, ...]:
        """Find a start; for each evaluation made, 0 or its failure code."""
        failures = self.chain.start(self._candidates(self._rng), (), self._rng)
        if self._measures_noise:
            state = self.chain.state
            seeds = draw_seeds(self._rng, (N_SEEDS, self._n_noisy))
            spread = self.chain.seed_spread(state.position, seeds)
            self._noisy_start = NoisyStart(self._target.model, self._index, spread)
        return failures

    def _warn_if_stuck(self) -> None:
        """Log that the start is too noisy, unless the chain has left it, as most do."""
        if self._noisy_start is not None and self.n_done >= N_STUCK:
            if not self.chain.draws.counts[:N_STUCK, STAGE].any():
                tell(self._noisy_start)
            self._noisy_start = None

    def _advance(self) -> None:
        """Advance to the end of the block of random numbers, or of the phase."""
        done = self.n_done
        tune = done < self._tune
        if tune:
            end = min(self._tune, self._n_iterations)
            self.chain.advance(tune, done, done, end - done)
        else:
            self.chain.advance_thinned(self._first + done, self._n_iterations - done)

    def _must_save(self) -> bool:
        due = time.monotonic() - self._saved_at >= CHECKPOINT_SECONDS
        return self._store is not None and due and self.n_done > self._n_saved

    def _save(self) -> None:
        if self._store is not None and self.n_done > self._n_saved:
            self._store(*self.chain.snapshot(self._n_saved))
            self._n_saved = self.n_done
        self._saved_at = time.monotonic()
