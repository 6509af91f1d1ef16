"""One Markov chain: its state, its draws, and the machine code that advances it.

PyMC's step method advances a `Chain` by one iteration at a time; `ChainTask` advances it block by
block in a thread. Both get the same draws from the same key.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pymc_statespace_filters.sampling.kernel.adaptation_state import (
    pack,
    packed_size,
    start_adaptation,
)
from pymc_statespace_filters.sampling.kernel.independence import no_mixture
from pymc_statespace_filters.sampling.kernel.random_numbers import BLOCK, draw_seeds
from pymc_statespace_filters.sampling.kernel.state import (
    ACCEPTANCE,
    FAILURE,
    N_COUNTS,
    N_DONE,
    N_EVALUATIONS,
    N_FAILED,
    N_NUMBERS,
    PAUSE_REQUESTED,
    SCALING,
    STAGE,
    ChainState,
    Draws,
    Evaluation,
    PhaseSettings,
    RandomBlock,
)
from pymc_statespace_filters.sampling.kernel.transition import advance
from pymc_statespace_filters.sampling.output.likelihood_variance import SeedSpread, seed_spread
from pymc_statespace_filters.sampling.target.initial_points import (
    EvaluatedPoint,
    best_initial_point,
)
from pymc_statespace_filters.sampling.target.target import Target


class StopRequested(Exception):
    """A stop was requested outside of the chain's iterations."""


class Chain:
    """A Markov chain of a prepared target.

    Parameters
    ----------
    target : Target
    key : ndarray of uint64, shape (2,)
        Key of the chain's random numbers.
    n_rows, n_covs : int
        Iterations whose draws are kept, and those, the first ones, whose proposal covariance is.
    proposal_cov : ndarray, shape (d, d), optional
        Of the first proposals. Default: the target's.
    """

    def __init__(
        self,
        target: Target,
        key: np.ndarray,
        n_rows: int,
        n_covs: int,
        proposal_cov: np.ndarray | None = None,
    ):
        self._target = target
        self._density = target.density.bind()
        self._screen = None if target.screen is None else target.screen.bind()
        dim, n_noisy = target.raveled.dim, len(target.seed_names)
        adaptation = np.empty(packed_size(dim))
        first_cov = target.first_cov if proposal_cov is None else proposal_cov
        pack(start_adaptation(first_cov), adaptation)
        self.state = ChainState(
            np.empty(dim),
            np.zeros(n_noisy, dtype=np.int64),
            np.zeros(3),
            adaptation,
            no_mixture(dim),
            self._density.carried,
            np.array(key),
        )
        self.draws = Draws(
            np.empty((n_rows, dim)),
            np.empty((n_rows, N_NUMBERS)),
            np.zeros((n_rows, N_COUNTS), dtype=np.int64),
            np.empty((n_rows, n_noisy), dtype=np.int64),
            np.empty((n_covs, dim, dim)),
        )
        # The control block, with the cells PAUSE_REQUESTED and N_DONE.
        self.control = np.zeros(2, dtype=np.int64)
        self._block: tuple[int, RandomBlock] | None = None

    @property
    def others(self) -> list[np.ndarray]:
        """Last values of the variables that other step methods move."""
        return self._density.others

    def start(
        self,
        candidates: Sequence[np.ndarray],
        others: Sequence[np.ndarray],
        rng: np.random.Generator,
    ) -> tuple[int, ...]:
        """Move to the best of the candidates, each evaluated with new noise.

        The last candidate is the point given by the user or the model; ``others`` are the values of
        variables that other step methods move. Returns 0 or the failure code of each evaluation.

        Raises
        ------
        StopRequested
            If a stop is requested meanwhile.
        Exception
            What the model raised.
        """
        self._density.correlation[...] = 0.0

        def evaluate(candidate: np.ndarray) -> EvaluatedPoint:
            self._check_pause()
            seeds = draw_seeds(rng, self.state.seeds.shape)
            if not self._target.settings.refresh_noise:
                seeds = self._target.fixed_seeds
            log_screen, failure = self._evaluate_screen(candidate, others, seeds)
            if log_screen == -np.inf:  # no move of the screen would ever leave this point
                return EvaluatedPoint(candidate, seeds, -np.inf, failure)
            value = self._density(candidate, others, seeds)
            return EvaluatedPoint(candidate, seeds, *value, log_screen)

        start, failures = best_initial_point(candidates, evaluate)
        if self.state.carried.size:  # later candidates have overwritten the noise of this one
            self._density(start.position, others, start.seeds)
        self._set_current(start)
        return failures

    def seed_spread(self, position: np.ndarray, seeds: np.ndarray) -> SeedSpread:
        """Measure the spread of estimates at a point over seeds, shape (R, noisy); as `start`."""

        def evaluate(*arguments: Any) -> Evaluation:
            self._check_pause()
            return self._density(*arguments)

        self._density.correlation[...] = 0.0
        spread = seed_spread(evaluate, position, (), seeds)
        self._restore_correlation()
        return spread

    def evaluate_again(self, others: Sequence[np.ndarray]) -> int:
        """Evaluate the current point and noise after other variables moved; its failure code.

        If the screen's log-density is minus infinity there, no move is accepted until they move.
        """
        self._density.correlation[...] = 1.0
        position, seeds = self.state.position.copy(), self.state.seeds.copy()
        log_screen, _ = self._evaluate_screen(position, others, seeds)
        value = self._density(position, others, seeds)
        self._set_current(EvaluatedPoint(position, seeds, *value, log_screen))
        return value.failure

    def advance(self, tune: bool, iteration: int, row: int, n: int) -> int:
        """Make up to n iterations, within one block of random numbers, and record them from a row.

        Returns the number of iterations made: fewer at the end of the block, or after a pause was
        requested. ``iteration`` counts from the start of the chain. Raises what the model raised.
        """
        random, first = self._random_numbers(iteration)
        n = min(n, BLOCK - first)
        target = self._density.native
        screen = target if self._screen is None else self._screen.native
        settings = self._phase_settings(tune)
        state, draws, control = self.state, self.draws, self.control
        done = advance(settings, target, screen, state, random, first, draws, row, n, control)
        if done < n and not control[PAUSE_REQUESTED]:
            for density in filter(None, (self._screen, self._density)):
                density.raise_error()
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
            "counts": counts.astype(np.int16),
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
        self._restore_correlation()

    def _random_numbers(self, iteration: int) -> tuple[RandomBlock, int]:
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
            self._screen is not None,
            tune,
            settings.adaptation == "continuous",
            int(settings.adapt_every),
        )

    def _check_pause(self) -> None:
        if self.control[PAUSE_REQUESTED]:
            raise StopRequested

    def _evaluate_screen(
        self, position: np.ndarray, others: Sequence[np.ndarray], seeds: np.ndarray
    ) -> tuple[float, int]:
        """Log-density of the screen, 0 without one, and its failure code."""
        if self._screen is None:
            return 0.0, 0
        value = self._screen(position, others, seeds)
        return value.log_density, value.failure

    def _set_current(self, point: EvaluatedPoint) -> None:
        """Take the point just evaluated, and its noise, as the current state."""
        state = self.state
        state.position[:], state.seeds[:] = point.position, point.seeds
        state.numbers[:] = point.log_density, point.n_effective, point.log_screen
        if state.carried.size:
            state.carried[:] = self._density.native.call.out[-state.carried.size :]
        self._restore_correlation()

    def _restore_correlation(self) -> None:
        """Set the correlation of the next proposals' noise to that of the settings."""
        if self._target.settings.correlation is not None:
            self._density.correlation[...] = self._target.settings.correlation
