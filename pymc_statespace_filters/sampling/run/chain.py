"""One chain while it runs: where it stands, and the arrays that its machine code works on."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pymc_statespace_filters.sampling.kernel.adaptation_state import (
    pack,
    packed_size,
    start_adaptation,
    unpack,
)
from pymc_statespace_filters.sampling.kernel.random_numbers import draw_seeds
from pymc_statespace_filters.sampling.kernel.state import (
    ACCEPTANCE,
    DONE,
    FAILURE,
    N_COUNTS,
    N_EVALUATIONS,
    N_FAILED,
    N_NUMBERS,
    PAUSE,
    SCALING,
    STAGE,
    Draws,
    Evaluation,
    Random,
    Settings,
    State,
)
from pymc_statespace_filters.sampling.kernel.transition import advance
from pymc_statespace_filters.sampling.output.likelihood_variance import SeedSpread, seed_spread
from pymc_statespace_filters.sampling.target.initial_points import EvaluatedPoint, best_start
from pymc_statespace_filters.sampling.target.target import Target


class Halted(Exception):
    """Somebody asked for a pause outside of the chain's iterations."""


class RunningChain:
    """A chain of a target.

    Parameters
    ----------
    target : Target
        Prepared.
    n_rows : int
        Iterations of which the draws are kept.
    n_covs : int
        Of how many of these, the first, the proposal covariance is kept.

    Attributes
    ----------
    state : State
    draws : Draws
    talk : ndarray of int64, shape (2,)
        See `chain_arrays.PAUSE` and `chain_arrays.DONE`.
    """

    def __init__(self, target: Target, n_rows: int, n_covs: int):
        self._target = target
        self._density = target.density.bind()
        self._screen = None if target.screen is None else target.screen.bind()
        dim, n_noisy = target.held.dim, len(target.seed_names)
        adaptation = np.empty(packed_size(dim))
        pack(start_adaptation(target.first_cov), adaptation)
        self.state = State(
            np.empty(dim),
            np.zeros(n_noisy, dtype=np.int64),
            np.zeros(3),
            adaptation,
            self._density.carried,
        )
        self.draws = Draws(
            np.empty((n_rows, dim)),
            np.empty((n_rows, N_NUMBERS)),
            np.zeros((n_rows, N_COUNTS), dtype=np.int64),
            np.empty((n_rows, n_noisy), dtype=np.int64),
            np.empty((n_covs, dim, dim)),
        )
        self.talk = np.zeros(2, dtype=np.int64)

    def start(
        self,
        candidates: Sequence[np.ndarray],
        others: Sequence[np.ndarray],
        rng: np.random.Generator,
    ) -> tuple[int, ...]:
        """Stand at the best of the candidates, each with noise of its own.

        Parameters
        ----------
        candidates : sequence of ndarray, shape (d,)
            The last one is where the chain was told to start.
        others : sequence of ndarray
            Values of the variables that other step methods move.
        rng : numpy.random.Generator

        Returns
        -------
        tuple of int
            For each evaluation made, 0 or the code of its failure.

        Raises
        ------
        Halted
            If somebody asked for a pause.
        Exception
            What the model raised.
        """
        self._density.correlation[...] = 0.0

        def evaluate_afresh(candidate: np.ndarray) -> EvaluatedPoint:
            self._heed_pause()
            seeds = self.noise(draw_seeds(rng, self.state.seeds.shape))
            log_screen, failure = self._evaluate_screen(candidate, others, seeds)
            if log_screen == -np.inf:  # no move would ever leave
                return EvaluatedPoint(candidate, seeds, -np.inf, failure)
            value = self._density(candidate, others, seeds)
            return EvaluatedPoint(candidate, seeds, *value, log_screen)

        start, codes = best_start(candidates, evaluate_afresh)
        if self.state.carried.size:  # the noise of the start, which others have overwritten
            self._density(start.position, others, start.seeds)
        self._stand(start)
        return codes

    def seed_spread(self, position: np.ndarray, seeds: np.ndarray) -> SeedSpread:
        """Measure the scatter of the estimates at a point over seeds (R, noisy).

        The chain stays where it is. Raises what `start` raises.
        """

        def evaluate_afresh(*arguments: Any) -> Evaluation:
            self._heed_pause()
            return self._density(*arguments)

        self._density.correlation[...] = 0.0
        spread = seed_spread(evaluate_afresh, position, (), seeds)
        self._move_noise()
        return spread

    def evaluate_again(self, others: Sequence[np.ndarray]) -> int:
        """Evaluate the current point with its noise where only others moved; its failure's code.

        Where the screen is impossible now, no move of it is accepted until others move again.
        """
        self._density.correlation[...] = 1.0
        position, seeds = self.state.position.copy(), self.state.seeds.copy()
        log_screen, _ = self._evaluate_screen(position, others, seeds)
        value = self._density(position, others, seeds)
        self._stand(EvaluatedPoint(position, seeds, *value, log_screen))
        return value.failure

    def adopt(self, state: State) -> None:
        """Go on from a state: a copy of it, as the machine code reads arrays of its own."""
        for mine, given in zip(self.state, state, strict=True):
            if mine is not given:
                mine[...] = given

    def snapshot(self, begin: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Draws from an iteration on, and the state, as plain arrays for a checkpoint.

        What has not changed since the iteration before is left out: most proposals are rejected.
        """
        rows = slice(begin, int(self.talk[DONE]))
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
        """Go on from all the snapshots of a checkpoint together."""
        done = len(draws["counts"])
        last_change = np.cumsum(draws["changed"]) - 1
        for name in ("positions", "numbers", "seeds"):
            getattr(self.draws, name)[:done] = draws[name][last_change]
        self.draws.counts[:done] = draws["counts"]
        self.draws.numbers[:done, ACCEPTANCE] = draws["acceptance"]
        self.draws.covs[: len(draws["covs"])] = draws["covs"]
        self.adopt(State(**state))
        self.talk[DONE] = done
        self._move_noise()

    def add_evaluations(self, codes: Sequence[int]) -> None:
        """Count evaluations made in Python, by the codes of their failures, to the first draw."""
        if codes:
            counts = self.draws.counts[0]
            failed = [code for code in codes if code]
            counts[N_EVALUATIONS] += len(codes)
            counts[N_FAILED] += len(failed)
            if failed and not counts[FAILURE]:
                counts[FAILURE] = failed[-1]

    @property
    def proposal_cov(self) -> np.ndarray:
        """Covariance of the first stage's proposals, shape (d, d)."""
        return unpack(self.state.adaptation, self.state.position.size).cov

    @property
    def others(self) -> list[np.ndarray]:
        """Values of the variables that other step methods move, as they were last."""
        return self._density.others

    def noise(self, fresh: np.ndarray) -> np.ndarray:
        """Seeds of an evaluation: those drawn, or the held ones in their place."""
        return fresh if self._target.settings.refresh_noise else self._target.held_seeds

    def advance(self, tune: bool, random: Random, first: int, row: int, n: int) -> int:
        """Make up to n iterations with random numbers from ``first``, noted down from ``row``.

        Returns
        -------
        int
            How many were made: fewer if somebody asked for a pause.

        Raises
        ------
        Exception
            What the model raised.
        """
        settings = self._target.settings
        phase = Settings(
            settings.stages[0 if tune else 1],
            float(settings.stage_scale),
            self._screen is not None,
            tune,
            settings.adaptation == "continuous",
            int(settings.adapt_every),
        )
        target = self._density.density
        screen = target if self._screen is None else self._screen.density
        done = advance(
            phase, target, screen, self.state, random, first, self.draws, row, n, self.talk
        )
        if done < n and not self.talk[PAUSE]:
            for density in filter(None, (self._screen, self._density)):
                density.raise_error()
            raise RuntimeError("the model's log-density raised an error, but not when asked again")
        return done

    def _heed_pause(self) -> None:
        if self.talk[PAUSE]:
            raise Halted

    def _evaluate_screen(
        self, position: np.ndarray, others: Sequence[np.ndarray], seeds: np.ndarray
    ) -> tuple[float, int]:
        """Log-density of the screen, 0 without one; and the code of its failure."""
        if self._screen is None:
            return 0.0, 0
        value = self._screen(position, others, seeds)
        return value.log_density, value.failure

    def _stand(self, point: EvaluatedPoint) -> None:
        """Take a point just evaluated as the current one, and its noise."""
        state = self.state
        state.position[:], state.seeds[:] = point.position, point.seeds
        state.numbers[:] = point.log_density, point.n_effective, point.log_screen
        if state.carried.size:
            state.carried[:] = self._density.density.call.out[-state.carried.size :]
        self._move_noise()

    def _move_noise(self) -> None:
        """From now on, move the noise by as much as the settings say."""
        if self._target.settings.correlation is not None:
            self._density.correlation[...] = self._target.settings.correlation
