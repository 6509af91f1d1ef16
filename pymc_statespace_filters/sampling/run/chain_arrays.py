"""The arrays of a Markov chain, the machine code that changes them, and what checkpoints store.

PyMC's step method advances a chain by one iteration at a time; `ChainTask` advances it block by
block in a thread. Both get the same draws from the same key.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...parallel.signals import held_interrupts
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


class StopRequested(Exception):
    """A stop was requested outside of the chain's iterations."""


class ChainArrays:
    """State and draws of a chain; what its iterations do is in the classes derived from this one.

    Parameters
    ----------
    target : Target or RecordTarget
        Prepared.
    state : ChainState
    n_rows : int
        Iterations whose draws are kept.
    n_counts : int
        Columns of the counts of a draw.
    covs : ndarray, shape (n_covs, d, d)
        For the proposal covariances of the first iterations.

    Attributes
    ----------
    state : ChainState
    draws : Draws
    control : ndarray of int64, shape (2,)
        The control block, with the cells PAUSE_REQUESTED and N_DONE.
    """

    def __init__(
        self,
        target: Target | RecordTarget,
        state: ChainState,
        n_rows: int,
        n_counts: int,
        covs: np.ndarray,
    ):
        self._target: Any = target
        self.state = state
        self.draws = Draws(
            np.empty((n_rows, state.position.size)),
            np.empty((n_rows, N_NUMBERS)),
            np.zeros((n_rows, n_counts), dtype=np.int64),
            np.empty((n_rows, state.seeds.size), dtype=np.int64),
            covs,
        )
        self.control = np.zeros(2, dtype=np.int64)
        self._block: tuple[int, Any] | None = None

    def advance(self, tune: bool, iteration: int, row: int, n: int) -> int:
        """Make up to n iterations, within one block of random numbers, and record them from a row.

        Returns the number of iterations made: fewer at the end of the block, or after a pause was
        requested. ``iteration`` counts from the start of the chain. Raises what the model raised.
        """
        random, first = self._random_numbers(iteration)
        n = min(n, BLOCK - first)
        with held_interrupts():
            done = self._iterate(self._phase_settings(tune), random, first, row, n)
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

        Rows that repeat the row before, as after a rejection, are stored once.
        """
        rows = slice(begin, int(self.control[N_DONE]))
        counts, numbers = self.draws.counts[rows], self.draws.numbers[rows]
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
            "covs": self.draws.covs[rows],
        }
        return draws, self.state._asdict()

    def restore(self, draws: dict[str, np.ndarray], state: dict[str, np.ndarray]) -> None:
        """Continue from the concatenated snapshots of a checkpoint."""
        done = len(draws["counts"])
        last_change = np.cumsum(draws["changed"]) - 1
        for name in ("positions", "numbers", "seeds"):
            getattr(self.draws, name)[:done] = draws[name][last_change]
        self.draws.counts[:done] = draws["counts"]
        self.draws.numbers[:done, ACCEPTANCE] = draws["acceptance"]
        self.draws.covs[: len(draws["covs"])] = draws["covs"]
        self.load_state(ChainState(**state))
        self.control[N_DONE] = done

    def _iterate(self, settings: PhaseSettings, random: Any, first: int, row: int, n: int) -> int:
        """Make up to n iterations in machine code; the number made."""
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
