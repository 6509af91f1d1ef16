"""The arrays of a Markov chain, the machine code that changes them, and what checkpoints store.

PyMC's step method advances a chain by one iteration at a time; `ChainTask` advances it block by
block in a thread. Both get the same draws from the same key.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...parallel.signals import held_interrupts
from ...progress import slow_compilation
from ..kernel.state import (
    ACCEPTANCE,
    BLOCK,
    FAILURE,
    N_DONE,
    N_EVALUATIONS,
    N_FAILED,
    N_NUMBERS,
    PAUSE_REQUESTED,
    SCALING,
    STAGE,
    ChainState,
    Draws,
    PhaseSettings,
)
from ..target.record_target import RecordTarget
from ..target.target import Target
from .thinned_draws import Thinning, add_iterations, coarsen, rows_of


class StopRequested(Exception):
    """A stop was requested outside of the chain's iterations."""


class ChainArrays:
    """State and draws of a chain; what its iterations do is in the classes derived from this one.

    Of the draws ``n_rows`` are kept, each with ``n_counts`` counts, and ``covs`` (n_covs, d, d) is
    for the proposal covariances of the first iterations. ``control`` (2,) is the control block,
    with the cells PAUSE_REQUESTED and N_DONE.
    """

    def __init__(
        self,
        target: Target | RecordTarget,
        state: ChainState,
        n_rows: int,
        n_counts: int,
        covs: np.ndarray,
        thinning: Thinning | None = None,
    ):
        self._target: Any = target
        self.state, self.thinning = state, thinning or Thinning(n_rows)
        self.draws = Draws(
            np.empty((n_rows, state.position.size)),
            np.empty((n_rows, N_NUMBERS)),
            np.zeros((n_rows, n_counts), dtype=np.int64),
            np.empty((n_rows, state.seeds.size), dtype=np.int64),
            covs,
        )
        self.control = np.zeros(2, dtype=np.int64)
        self._block: tuple[int, Any] | None = None
        # Counts of the row that was not full when the draws were last saved.
        self._saved_counts = np.zeros(n_counts, dtype=np.int64)

    @property
    def position(self) -> np.ndarray:
        """Where the chain is, in the coordinates of the model."""
        return self.state.position

    def compile(self) -> None:
        """Compile the iterations, or load them from disk, without making one."""
        with slow_compilation("the random walk"):
            self.advance(True, 0, 0, 0)

    def advance(self, tune: bool, iteration: int, row: int, n: int) -> int:
        """Make up to n iterations, within one block of random numbers, and record them from a row.

        Returns the number of iterations made: fewer at the end of the block, or after a pause was
        requested. ``iteration`` counts from the start of the chain. Raises what the model raised.
        """
        return self._advance(tune, iteration, self.draws, row, n)

    def advance_thinned(self, iteration: int, n: int) -> int:
        """As `advance`, after the warm-up, into the draws that ``thinning`` keeps."""
        made = int(self.control[N_DONE])
        if self.thinning.every == 1:
            return self.advance(False, iteration, made, n)
        every = self._empty_block()
        done = self._advance(False, iteration, every, 0, n)
        rows = self.thinning.rows(np.arange(made, made + done))
        add_iterations(self.draws, rows, rows_of(every, slice(0, done)))
        return done

    def _empty_block(self) -> Draws:
        arrays = self.draws._asdict()
        covs = arrays.pop("covs")[:0]
        return Draws(
            **{name: np.zeros((BLOCK, *a.shape[1:]), a.dtype) for name, a in arrays.items()},
            covs=covs,
        )

    def coarsen(self, every: int) -> None:
        """Keep from now on the last of more iterations, also of those made."""
        after = self.thinning._replace(every=every)
        full = self.thinning.n_rows(int(self.control[N_DONE]))
        coarsen(self.draws, full, self.thinning, after)
        self.thinning = after
        self._note_saved()

    def _advance(self, tune: bool, iteration: int, draws: Draws, row: int, n: int) -> int:
        random, first = self._random_numbers(iteration)
        n = min(n, BLOCK - first)
        with held_interrupts():
            done = self._iterate(self._phase_settings(tune), random, first, draws, row, n)
        if done < n and not self.control[PAUSE_REQUESTED]:
            self._raise_error()
            raise RuntimeError("the model's log-density raised an error that did not occur again")
        return done

    def add_evaluations(self, failures: Sequence[int]) -> None:
        """Add evaluations made in Python, given by their failure codes, to the first draw."""
        if failures:
            counts = self.draws.counts[0]
            failed = [code for code in failures if code]
            counts[N_EVALUATIONS] += len(failures)
            counts[N_FAILED] += len(failed)
            if failed and not counts[FAILURE]:
                counts[FAILURE] = failed[-1]

    def load_state(self, state: ChainState) -> None:
        """Continue from a state, copied into the arrays that the machine code reads."""
        for mine, given in zip(self.state, state, strict=True):
            if mine is not given:
                mine[...] = given
        self._block = None

    def snapshot(self, begin: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Draws from an iteration on, and the state, as plain arrays for a checkpoint.

        ``ends`` are the iterations after which the rows were as they are stored. Of a row that was
        stored before it was full, the counts are those since then. Rows that repeat the row before,
        as after a rejection, are stored once.
        """
        done = int(self.control[N_DONE])
        first, last = self.thinning.rows(np.array([begin, done - 1])).tolist()
        rows = slice(first, last + 1)
        counts, numbers = self.draws.counts[rows].copy(), self.draws.numbers[rows]
        additive = np.ones(counts.shape[1], dtype=bool)
        additive[[STAGE, FAILURE]] = False
        counts[0, additive] -= self._saved_counts[additive]
        ends = [self.thinning.n_iterations(row + 1) for row in range(first, last + 1)]
        changed = counts[:, STAGE] > 0
        changed[1:] |= numbers[1:, SCALING] != numbers[:-1, SCALING]
        changed[:1] = True
        draws = {
            "counts": counts.astype(np.int32),
            "acceptance": numbers[:, ACCEPTANCE],
            "changed": changed,
            "positions": self.draws.positions[rows][changed],
            "numbers": numbers[changed],
            "seeds": self.draws.seeds[rows][changed],
            "ends": np.minimum(ends, done),
            "covs": self.draws.covs[rows],
        }
        self._note_saved()
        return draws, self.state._asdict()

    def restore(self, draws: dict[str, np.ndarray], state: dict[str, np.ndarray]) -> None:
        """Continue from the concatenated snapshots of a checkpoint."""
        last_change = np.cumsum(draws["changed"]) - 1
        positions, numbers, seeds = (
            draws[name][last_change] for name in ("positions", "numbers", "seeds")
        )
        numbers[:, ACCEPTANCE] = draws["acceptance"]
        stored = Draws(positions, numbers, draws["counts"], seeds, self.draws.covs[:0])
        add_iterations(self.draws, self.thinning.rows(draws["ends"] - 1), stored)
        self.draws.covs[: len(draws["covs"])] = draws["covs"]
        self.load_state(ChainState(**state))
        self.control[N_DONE] = draws["ends"][-1]
        self._note_saved()

    def _note_saved(self) -> None:
        """Note the counts of the row that is not full, all of which are stored."""
        done = int(self.control[N_DONE])
        full = self.thinning.n_rows(done)
        is_full = self.thinning.n_iterations(full) == done
        self._saved_counts[:] = 0 if is_full else self.draws.counts[full]

    def _iterate(
        self, settings: PhaseSettings, random: Any, first: int, draws: Draws, row: int, n: int
    ) -> int:
        """Make up to n iterations in machine code, recorded from a row; the number made."""
        raise NotImplementedError

    def _raise_error(self) -> None:
        """Raise the error of the machine code."""
        raise NotImplementedError

    def _random_numbers(self, iteration: int) -> tuple[Any, int]:
        """The block of random numbers of an iteration, and the row of the iteration in it."""
        index, row = divmod(iteration, BLOCK)
        if self._block is None or self._block[0] != index:
            self._block = index, self._target.random_block(self.state.key, index)
        return self._block[1], row

    def _phase_settings(self, tune: bool) -> PhaseSettings:
        settings = self._target.settings
        return PhaseSettings(
            settings.stages[0 if tune else 1],
            float(settings.stage_scale),
            settings.screen is not None,
            tune,
            settings.adaptation == "continuous",
            int(settings.adapt_every),
        )

    def _check_pause(self) -> None:
        if self.control[PAUSE_REQUESTED]:
            raise StopRequested
