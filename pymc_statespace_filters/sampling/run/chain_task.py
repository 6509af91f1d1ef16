"""A chain run from its start, or from its checkpoint, to its end, in one thread.

The thread spends nearly all its time in machine code, without the interpreter lock. It returns to
Python for the next block of random numbers, and when the main thread has requested a pause: to
write a checkpoint, or to stop.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, InitVar, dataclass
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


@dataclass(eq=False)
class ChainTask:
    """One chain to be run, from its start or from what a former call has stored of it."""

    target: Target | RecordTarget  # prepared
    tune: int
    n_iterations: int  # after which the chain ends; `extend` gives it more
    candidates: Candidates  # for its start, from the chain's generator
    seed: InitVar[np.random.SeedSequence]  # of the chain's randomness
    _: KW_ONLY
    n_rows: InitVar[int]  # draws, with those of the warm-up, that it may have after `extend`
    mixture: InitVar[np.ndarray]  # packed, of the first proposals
    thin: InitVar[int] = 1  # iterations after the warm-up of which one draw, the last, is kept
    proposal_cov: InitVar[np.ndarray | None] = None  # of the first; by default the target's
    index: int = 0
    name: str = "chain 0"  # for messages
    stored: InitVar[Stored | None] = None
    store: Store | None = None
    keeps_warmup: InitVar[bool] = False
    measures_noise: bool = False  # of the estimated log-likelihood, at the start
    former: InitVar[tuple[ChainState, int] | None] = None  # to go on, and the number of iterations

    def __post_init__(
        self,
        seed: np.random.SeedSequence,
        n_rows: int,
        mixture: np.ndarray,
        thin: int,
        proposal_cov: np.ndarray | None,
        stored: Stored | None,
        keeps_warmup: bool,
        former: tuple[ChainState, int] | None,
    ) -> None:
        target, n_covs = self.target, self.tune if keeps_warmup else 0
        self.rng = np.random.default_rng(seed)
        # Pages of these arrays that are never written to take no memory.
        self.chain = chain_of(
            target, draw_key(self.rng), n_rows, n_covs, proposal_cov, Thinning(self.tune, thin)
        )
        self.chain.state.mixture[:] = mixture
        self._first, self._goes_on = 0, former is not None
        if former is not None:
            state, self._first = former
            self.chain.load_state(state)
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
        return self.chain.draws.positions[self.tune : self._n_rows]

    @property
    def _n_rows(self) -> int:
        """Draws of the iterations made so far, with those of the warm-up."""
        return self.chain.thinning.n_rows(min(self.n_done, self.n_iterations))

    def extend(self, n_iterations: int, thin: int, mixture: np.ndarray) -> None:
        """Let the chain, which has ended, run again, until it has made so many iterations.

        Of more of them, one is kept from now on. A chain from a checkpoint that is further has this
        mixture, or a later one.
        """
        if thin > self.chain.thinning.every:
            self.chain.coarsen(thin)
        if self.n_done == self.n_iterations:
            self.chain.state.mixture[:] = mixture
        self.n_iterations = n_iterations

    def request_pause(self, stop: Event) -> None:
        """Have the chain return to Python if it is to stop or to be saved."""
        if stop.is_set() or self._must_save():
            self.chain.control[PAUSE_REQUESTED] = 1

    def run(self, stop: Event) -> None:
        """Run to the end, or until the event is set."""
        began = time.monotonic()
        try:
            failures = () if self._goes_on or self.n_done > 0 else self._start()
            while self.n_done < self.n_iterations and not stop.is_set():
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
            error.add_note(f"in {self.name}, after {self.n_done} iterations")
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
        begin = self.tune if end > self.tune else 0
        n = thinning.n_iterations(end) - begin
        return {
            "accept_rate": float(n_accepted(draws.counts[begin:end]).mean(axis=1).sum() / n),
            "n_failed": int(draws.counts[end - 1, N_FAILED]),
        }

    def _start(self) -> tuple[int, ...]:
        """Find a start; for each evaluation made, 0 or its failure code."""
        failures = self.chain.start(self.candidates(self.rng), (), self.rng)
        if self.measures_noise:
            seeds = draw_seeds(self.rng, (N_SEEDS, len(self.target.seed_names)))
            spread = self.chain.seed_spread(self.chain.position, seeds)
            self._noisy_start = NoisyStart(self.target.model, self.index, spread)
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
        tune = done < self.tune
        if tune:
            end = min(self.tune, self.n_iterations)
            self.chain.advance(tune, done, done, end - done)
        else:
            self.chain.advance_thinned(self._first + done, self.n_iterations - done)

    def _must_save(self) -> bool:
        due = time.monotonic() - self._saved_at >= CHECKPOINT_SECONDS
        return self.store is not None and due and self.n_done > self._n_saved

    def _save(self) -> None:
        if self.store is not None and self.n_done > self._n_saved:
            self.store(*self.chain.snapshot(self._n_saved))
            self._n_saved = self.n_done
        self._saved_at = time.monotonic()
